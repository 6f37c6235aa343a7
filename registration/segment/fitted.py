"""The fitted head as cameras see it: the class, depth and incidence of its surface at each pixel."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from registration.capture.class_names import BACKGROUND, NECK
from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import edges, vertex_normals
from registration.model.gnm_npz import GNMData
from registration.model.regions import CLASSES as MODEL_CLASSES
from registration.model.regions import neck_other, vertex_classes
from registration.types import Camera

HAIR, BEARD, CLOTH, GLASSES, UNLABELLED = "hair", "beard", "cloth", "glasses", "unlabelled"
FOREIGN = (HAIR, BEARD, CLOTH, GLASSES)
CLASSES = (BACKGROUND, *MODEL_CLASSES, NECK, *FOREIGN, UNLABELLED)  # of the label maps, in index order
INDEX = {name: index for index, name in enumerate(CLASSES)}


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedView:
    """What one camera sees of the fitted head at the centre of each pixel."""

    camera: Camera
    face: Int[np.ndarray, "H W"]  # -1 where there is none
    barycentric: Float[np.ndarray, "H W 3"]
    labels: Int[np.ndarray, "H W"]  # index into `CLASSES`
    depth: Float[np.ndarray, "H W"]  # along the optical axis, metres; 0 where there is no surface
    cosine: Float[np.ndarray, "H W"]  # of incidence; 0 where there is no surface

    @property
    def inside(self) -> Bool[np.ndarray, "H W"]:
        """The silhouette."""
        return self.face >= 0


class FittedHead:
    """A fitted head of a model's topology, prepared for several views; world frame, metres."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], data: GNMData):
        """Build the tree of its triangles.

        Args:
            vertices: metres, world, finite.
            data: the model.
        """
        self.vertices: Float[np.ndarray, "V 3"] = np.asarray(vertices, np.float64)
        self.data = data
        self.triangles: Int[np.ndarray, "F 3"] = data.triangles.astype(np.int64)
        self._caster = RayCaster(self.vertices, self.triangles)
        centred = torch.from_numpy(self.vertices - self.vertices.mean(0))
        self.normals: Float[np.ndarray, "V 3"] = vertex_normals(centred, torch.from_numpy(self.triangles)).numpy()
        weights, neck = vertex_classes(data)[1], neck_other(data)
        self._weights = np.zeros((len(weights), len(CLASSES)), np.float32)
        for index, name in enumerate(MODEL_CLASSES):
            self._weights[:, INDEX[name]] = weights[:, index]
        skin = INDEX[MODEL_CLASSES[0]]
        self._weights[:, INDEX[NECK]] = self._weights[:, skin] * neck
        self._weights[:, skin] *= ~neck

    @cached_property
    def edges(self) -> Int[np.ndarray, "E 2"]:
        """The mesh's edges."""
        return edges(self.triangles).vertices

    def view(self, camera: Camera) -> FittedView:
        """Render the head for one camera without distortion."""
        face, barycentric = self._caster.rasterize(camera)
        hit = face >= 0
        corners, share = self.triangles[face[hit]], barycentric[hit]
        labels = np.full(face.shape, INDEX[BACKGROUND])
        labels[hit] = np.einsum("pk,pkc->pc", share, self._weights[corners]).argmax(1)
        point = np.einsum("pk,pkc->pc", share, self.vertices[corners])
        normal = np.einsum("pk,pkc->pc", share, self.normals[corners])
        towards = camera.centre - point
        lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
        depth, cosine = np.zeros(face.shape), np.zeros(face.shape)
        depth[hit] = point @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
        cosine[hit] = np.abs((normal * towards).sum(1)) / np.maximum(lengths, 1e-12)
        return FittedView(camera=camera, face=face, barycentric=barycentric, labels=labels, depth=depth, cosine=cosine)

    def at_pixels(self, values: Float[np.ndarray, "V"], view: FittedView) -> Float[np.ndarray, "H W"]:
        """Interpolate values of the vertices to the pixels of a view; 0 where there is no surface."""
        image, hit = np.zeros(view.face.shape), view.face >= 0
        corners = self.triangles[view.face[hit]]
        image[hit] = (view.barycentric[hit] * np.asarray(values)[corners]).sum(1)
        return image

    def seen(self, camera: Camera, least_cosine: float) -> Int[np.ndarray, "S"]:
        """Return the vertices that a camera sees at a cosine of incidence of at least this."""
        towards = camera.centre - self.vertices
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        rows = np.flatnonzero((towards * self.normals).sum(1) >= least_cosine)
        return rows[self._caster.visible(self.vertices[rows], camera)]

    def smoothed(
        self, values: Float[np.ndarray, "V"], weight: Float[np.ndarray, "V"], rounds: int
    ) -> Float[np.ndarray, "V"]:
        """Average values over neighbours some times, each with its weight; what has none takes its neighbours'."""
        total, mass = np.nan_to_num(values) * weight, np.asarray(weight, np.float64).copy()
        start, end = np.concatenate([self.edges, self.edges[:, ::-1]]).T
        degree = np.bincount(start, minlength=len(total)) + 1.0
        for _ in range(rounds):
            total = (total + np.bincount(start, total[end], len(total))) / degree
            mass = (mass + np.bincount(start, mass[end], len(mass))) / degree
        return np.divide(total, mass, out=np.zeros_like(total), where=mass > 1e-9)
