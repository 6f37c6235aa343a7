"""Where a model puts the neck's vertices if everything that images may show were known: a bound for registrations."""

import numpy as np
import torch
from jaxtyping import Float

from registration.frames import MM_PER_M, axis_angle_to_matrix
from registration.geometry.topology import vertex_normals
from registration.model import regions
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.types import Registration

# Errors of a model that does not span the person are smooth: so many vertices count as one observation.
_HEAD_VERTICES, _NECK_VERTICES = 20, 5
_ITERATIONS = 150


def known_head(data: GNMData, registration: Registration, truth: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """Fit a model's parameters to the true vertices of the head's skin and to the true surface of the neck.

    The most probable parameters under the model's prior, with residuals of 1 mm: the neck's vertices are left to what
    the model knows of necks of such heads.

    Args:
        data: the model.
        registration: where the parameters start.
        truth: true vertices, metres, in the registration's frame.

    Returns:
        The model's vertices, in the same frame.
    """
    model, target = GNM(data), torch.as_tensor(truth.astype(np.float32))
    normals = vertex_normals(target, torch.as_tensor(data.triangles.astype(np.int64)))
    head = torch.as_tensor(regions.head_skin(data))
    neck = torch.as_tensor(regions.exterior(data) & regions.neck_other(data))
    start = registration
    values = (start.identity, start.expression, start.rotations, start.translation, np.log(start.scale))
    free = [torch.tensor(np.asarray(value), dtype=torch.float32).requires_grad_(True) for value in values]
    identity, expression, rotations, translation, log_scale = free

    def vertices() -> torch.Tensor:
        bind, joints = model.bind(identity, expression), model.joints(identity)
        return log_scale.exp() * model.pose(bind, joints, axis_angle_to_matrix(rotations)) + translation

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        apart_mm = (vertices() - target) * MM_PER_M
        across_mm = (apart_mm[neck] * normals[neck]).sum(-1)
        observed = apart_mm[head].square().sum() / _HEAD_VERTICES + across_mm.square().sum() / _NECK_VERTICES
        total = observed + identity.square().sum() + expression.square().sum()
        total.backward()
        return total

    optimizer = torch.optim.LBFGS(free, max_iter=_ITERATIONS, line_search_fn="strong_wolfe")
    optimizer.step(loss)
    return vertices().detach().numpy()
