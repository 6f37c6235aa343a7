"""A model of FLAME's shape, made from a GNM model: 5,023 vertices, its own bases, and a jaw joint of its own.

Skin and eyeballs only, as FLAME has them; components are principal, over the whole head. It stands in for FLAME where
its file must not be: numbers that are measured with it say nothing about FLAME itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy import sparse

from bench.support.python2_pickle import Chumpy, write_pickle
from bench.support.resampling import resample
from registration.geometry.closest_point import closest_points
from registration.geometry.smoothstep import smoothstep
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme, write_scheme

VERTICES = 5023
_MOUTH_CORNERS, _EARS, _CHIN = (48, 54), (0, 16), 8  # rows of the scheme of 68 points
_FILL_M = 1e-4  # standard deviation of components beyond those that the GNM model has
_CORRECTIVE_M = 2e-3  # per radian of the jaw, at most


@dataclass(frozen=True, kw_only=True)
class FlameShape:
    """How large the model is."""

    vertices: int = VERTICES
    identity: int = 300
    expression: int = 100
    seed: int = 0


def flame_shaped(
    data: GNMData, landmarks: LandmarkScheme, shape: FlameShape | None = None
) -> tuple[dict[str, np.ndarray], LandmarkScheme]:
    """Return the arrays of a FLAME file by their names there, double precision, and its 68 landmarks.

    Args:
        data: the GNM model, metres.
        landmarks: its scheme of 68 points.
        shape: sizes; None: FLAME's.
    """
    shape = shape or FlameShape()
    carried, triangles = _head(data, shape.vertices)
    template = carried @ data.template_vertex_positions.astype(np.float64)
    points = landmarks.points(data.template_vertex_positions.astype(np.float64))
    eyes = np.stack([carried @ regions.group(data, f"{side}_eye") > 0.5 for side in ("left", "right")])
    pivot, jaw = _jaw(carried, template, points, data, eyes)
    rng = np.random.default_rng(shape.seed)
    opened = jaw[:, None] * np.cross([1.0, 0.0, 0.0], template - pivot)
    identity = _principal(carried, data.vertex_identity_basis, template, shape.identity, rng)
    expression = _principal(carried, data.expression_basis, template, shape.expression, rng, without=opened)
    weights = np.zeros((shape.vertices, 5))
    above = smoothstep(*(points[_CHIN, 1] + np.array([-0.06, 0.0])), template[:, 1])
    weights[:, 0], weights[:, 1] = 1 - above, above
    weights[:, :2] *= (1 - jaw)[:, None]
    weights[:, 2] = jaw
    weights[eyes.any(0)] = 0
    weights[eyes[0], 3], weights[eyes[1], 4] = 1, 1
    neck = np.array([0, points[_CHIN, 1] - 0.02, pivot[2]])
    joints = np.stack([neck - [0, 0.08, 0], neck, pivot, *(template[eye].mean(0) for eye in eyes)])
    correctives = np.zeros((shape.vertices, 3, 36))
    folds = 4 * (jaw * (1 - jaw))[:, None, None] * rng.normal(size=(1, 3, 9))
    correctives[:, :, 9:18] = _CORRECTIVE_M * np.tanh(folds)
    arrays = {
        "v_template": template,
        "f": triangles.astype(np.uint32),
        "shapedirs": np.concatenate([identity, expression]).transpose(1, 2, 0),
        "posedirs": correctives,
        "J_regressor": np.stack([_regressor(template, joint) for joint in joints]),
        "weights": weights,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
        "J": joints,
    }
    _, face, barycentric = closest_points(points, template, triangles)
    scheme = LandmarkScheme(name="68", indices=triangles[face].astype(np.int64), weights=barycentric)
    return arrays, replace(scheme, header={"made": "closest points of another model's landmarks"})


def write_flame_pickle(arrays: Mapping[str, np.ndarray], path: Path, landmarks: LandmarkScheme | None = None) -> Path:
    """Write arrays as the published files are: Python 2, protocol 2, chumpy, a sparse regressor. Returns the path."""
    values: dict[str, object] = {name: array for name, array in arrays.items()}
    for name in ("v_template", "shapedirs", "posedirs", "weights", "J"):
        values[name] = Chumpy(arrays[name])
    values["J_regressor"] = sparse.csc_matrix(arrays["J_regressor"])
    write_pickle({**values, "bs_style": "lbs", "bs_type": "lrotmin"}, path)
    return _with_landmarks(path, landmarks)


def write_flame_npz(arrays: Mapping[str, np.ndarray], path: Path, landmarks: LandmarkScheme | None = None) -> Path:
    """Write arrays as an NPZ file. Returns the path."""
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return _with_landmarks(path, landmarks)


def _with_landmarks(path: Path, landmarks: LandmarkScheme | None) -> Path:
    if landmarks is not None:
        write_scheme(landmarks, path)
    return path


def _head(data: GNMData, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """From all vertices to those of skin and eyeballs at another density, and the triangles."""
    part = regions.components(data)
    names = data.mesh_component_names.tolist()
    eyes = np.isin(part, [names.index(name) for name in ("left_eye", "right_eye")])
    inside = (regions.group(data, "mouth_sock") > 0.5) | (regions.group(data, "eye_sockets") > 0.5)
    kept = eyes | ((part == names.index("skin")) & ~inside)
    triangles = data.triangles[kept[data.triangles].all(1)].astype(np.int64)
    used, triangles = np.unique(triangles, return_inverse=True)
    chosen = sparse.csr_matrix((np.ones(len(used)), (np.arange(len(used)), used)), shape=(len(used), len(kept)))
    points = data.template_vertex_positions[used].astype(np.float64)
    carried, triangles = resample(points, triangles.reshape(-1, 3), count)
    return carried @ chosen, triangles


def _jaw(
    carried: sparse.csr_matrix, template: np.ndarray, points: np.ndarray, data: GNMData, eyes: np.ndarray
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "V"]]:
    """The jaw's pivot, between the ears, and the share of each vertex that turns with it."""
    lips = points[list(_MOUTH_CORNERS)].mean(0)
    pivot = points[list(_EARS)].mean(0) * [0, 1, 1]
    pivot[1] = max(pivot[1], lips[1] + 0.02)
    along = lips - pivot
    down = np.array([0, -along[2], along[1]])
    down = down / np.linalg.norm(down) * (1 if down[2] >= 0 or down[1] < 0 else -1)
    below = (template - pivot) @ down
    chin = (points[_CHIN] - pivot) @ down
    share = smoothstep(0, 0.35 * chin, below) * smoothstep(1.8 * chin, 1.15 * chin, below)
    share = share * smoothstep(pivot[2], pivot[2] + 0.4 * np.linalg.norm(along), template[:, 2])
    share[carried @ regions.group(data, "upper_lip") > 0.5] = 0
    lower = carried @ regions.group(data, "lower_lip") > 0.5
    share[lower] = np.maximum(share[lower], 0.9)
    return pivot, np.where(eyes.any(0), 0, share)


def _principal(
    carried: sparse.csr_matrix,
    basis: np.ndarray,
    template: np.ndarray,
    count: int,
    rng: np.random.Generator,
    *,
    without: np.ndarray | None = None,
) -> Float[np.ndarray, "K V 3"]:
    """The principal components of a basis' heads in standard deviations, then small smooth ones up to `count`.

    `without`: a displacement that the components must not contain.
    """
    moved = np.stack([carried @ component for component in basis.astype(np.float64)]).reshape(len(basis), -1)
    if without is not None:
        unit = without.ravel() / np.linalg.norm(without)
        moved -= (moved @ unit)[:, None] * unit
    values, vectors = np.linalg.eigh(moved @ moved.T)
    order = np.argsort(values)[::-1][:count]
    components = (vectors[:, order].T @ moved).reshape(len(order), -1, 3)
    if (missing := count - len(order)) > 0:
        frequencies = rng.normal(size=(3, 64)) / 0.05
        waves = np.cos(template @ frequencies + rng.uniform(0, 2 * np.pi, 64))
        smooth = np.einsum("vw,kwc->kvc", waves, rng.normal(size=(missing, 64, 3)) / 8)
        components = np.concatenate([components, _FILL_M * smooth])
    return components


def _regressor(template: np.ndarray, joint: np.ndarray, near: int = 60) -> Float[np.ndarray, "V"]:
    """Weights of the nearest vertices, with the sum 1, whose mean is the joint."""
    distances = np.linalg.norm(template - joint, axis=1)
    chosen = np.argsort(distances)[:: max(1, len(template) // 1000)][:near]
    equations = np.concatenate([template[chosen].T, np.ones((1, len(chosen)))])
    row = np.zeros(len(template))
    row[chosen] = np.linalg.lstsq(equations, np.append(joint, 1.0), rcond=None)[0]
    return row
