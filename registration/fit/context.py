"""The parts of a fit that do not depend on the initial guess: model, targets, recipe, and what is derived from them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.fit.recipes import Recipe
from registration.fit.variables import skin_triangles, skin_vertices
from registration.geometry.folds import Creases
from registration.geometry.large_steps import spacing
from registration.geometry.nearest_planes import NearestPlanes
from registration.geometry.topology import grown
from registration.landmark_fit.observations import Observations
from registration.losses import depth
from registration.losses.folds import FoldPenalty
from registration.losses.scan import ScanDistance
from registration.losses.self_intersection import SelfIntersectionPenalty
from registration.losses.uv_ssim import UVSSIM
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import crossing_parts, exterior, head_skin, offset_regions, vertex_classes
from registration.render.renderer import Renderer
from registration.targets.classes import ClassMap
from registration.types import Registration, Rendered, SurfaceHits, Targets

# Surfaces of their own: where a pixel shows one and its target another, only classes are compared.
_SEPARATE_SURFACES = ("left_eye", "right_eye", "mouth_interior")
_REGION_RINGS = 2  # of vertices around an offset region that belong to it, so that its boundary can follow


@dataclass(frozen=True, kw_only=True, eq=False)
class FitContext:
    """The inputs of a fit, and what is derived from them once, when it is first needed."""

    data: GNMData
    model: GNM  # the same model as a function, on the device of the fit
    pyramid: tuple[Targets, ...]  # level 0 is the finest
    classes: ClassMap
    schemes: Mapping[str, LandmarkScheme]  # of the model
    corner_uvs: Float[np.ndarray, "F 3 2"]  # of the texture's atlas
    recipe: Recipe
    seed: int
    neutral: Registration | None = None  # of the subject, if the capture shows an expression
    # Landmarks of the capture by scheme, triangulated over its views; world, metres; NaN where not possible.
    triangulated: Mapping[str, Float[np.ndarray, "L 3"]] = field(default_factory=dict)
    # Standard deviation of these along each axis, metres, of schemes whose detector states its spread.
    triangulated_spread_m: Mapping[str, Float[np.ndarray, "L"]] = field(default_factory=dict)
    seen_landmarks: Observations | None = None  # the same landmarks in the views
    scan: NearestPlanes | None = None  # whose surface is fitted; world, metres
    # Expected error of each given camera, rms shift of the head's points, px of level 0; None: cameras are exact.
    camera_sigma_px: Float[np.ndarray, "N"] | None = None

    @property
    def device(self) -> torch.device:
        """The device of all tensors of the fit."""
        return self.model.template.device

    @property
    def view_count(self) -> int:
        """How many views there are."""
        return len(self.pyramid[0].names)

    @cached_property
    def texture_px(self) -> int:
        """Width and height of the texture: the recipe's, or less, so that the images' pixels reach every texel.

        The atlas is about as wide as two heads are high.
        """
        return min(self.recipe.texture_px, 2 ** math.ceil(math.log2(2 * self.pyramid[0].px_per_head)))

    @cached_property
    def renderer(self) -> Renderer:
        """The renderer of the model's mesh."""
        return Renderer(
            self.data.triangles,
            self.corner_uvs,
            vertex_classes(self.data)[1] @ self.classes.from_model,
            parts=crossing_parts(self.data) * bool(self.recipe.edge_samples),  # a single part has no crossings
            edge_samples=self.recipe.edge_samples,
            seed=self.seed,
        )

    @cached_property
    def view_order(self) -> "ViewOrder":
        """The order in which steps take views."""
        return ViewOrder(np.stack([camera.centre for camera in self.pyramid[0].pixels.cameras]), self.seed)

    @cached_property
    def captured_schemes(self) -> dict[str, LandmarkScheme]:
        """The landmark schemes that model and capture share."""
        return {name: scheme for name, scheme in self.schemes.items() if name in self.pyramid[0].landmarks}

    def landmark_spread_m(self, name: str) -> Float[np.ndarray, "L"] | None:
        """Return how far triangulated landmarks may be from the points of the model's scheme.

        Returns:
            The standard deviation along each axis, metres, of detections and scheme; NaN where not triangulated. None:
            neither detector nor scheme states one.
        """
        triangulated, scheme = self.triangulated_spread_m.get(name), self.schemes[name].spread_m
        known = [spread for spread in (triangulated, scheme) if spread is not None]
        return np.sqrt(np.sum(np.square(known), axis=0)) if known else None

    @cached_property
    def separate_surfaces(self) -> list[int]:
        """Classes that are surfaces of their own (`losses.image.pixel_agreement`)."""
        return [self.classes.names.index(name) for name in _SEPARATE_SURFACES if name in self.classes.names]

    @cached_property
    def skin(self) -> "SkinMesh":
        """The part of the mesh that carries free offsets."""
        return SkinMesh.from_model(self.data, self.recipe)

    @cached_property
    def self_intersection(self) -> SelfIntersectionPenalty:
        """The penalty on intersections between parts of the head."""
        return SelfIntersectionPenalty(self.data, self.device)

    @cached_property
    def outer_skin(self) -> Bool[np.ndarray, "V"]:
        """The vertices of the skin that may not fold."""
        return exterior(self.data)

    @cached_property
    def creases(self) -> Creases:
        """The edges of the outer skin, which may become folds."""
        return Creases.of(self.data.triangles, self.data.template_vertex_positions, self.outer_skin)

    @cached_property
    def folds(self) -> FoldPenalty:
        """The penalty on folds of the outer skin."""
        return FoldPenalty(self.creases, self.device)

    @cached_property
    def scan_distance(self) -> ScanDistance | None:
        """The distance of the head's skin, as the cameras see it, from the scan, if one is fitted."""
        if self.scan is None:
            return None
        finest = self.pyramid[0]
        compared = (finest.rgb_weight > 0) | (finest.normal_weight > 0)  # no hair; bare scans have no colours
        shown = finest.pixels.image(compared.float()[:, None])[..., 0].numpy() > 0
        rows = np.flatnonzero(head_skin(self.data))
        return ScanDistance(self.scan, rows, self.data.triangles, finest.pixels.cameras, list(shown))

    @cached_property
    def triangles(self) -> Int[Tensor, "F 3"]:
        """Those of the model's mesh."""
        return torch.as_tensor(self.data.triangles.astype(np.int64), device=self.device)

    def depth_distances(
        self, vertices: Float[Tensor, "V 3"], rendered: Rendered, targets: Targets, agree: Bool[Tensor, "P"]
    ) -> tuple[SurfaceHits, Float[Tensor, "H"], Float[Tensor, "H"]]:
        """Return where the skin is compared with depth maps, its distances (m), and their weights.

        Args:
            vertices: of the mesh, in which the distances are differentiable; world, metres.
            rendered: the mesh at the targets' pixels.
            targets: with depths.
            agree: pixels where both show the same kind of surface.
        """
        shown = self.renderer.surface(vertices.detach(), targets.pixels)
        hits, weight = depth.compared(shown, rendered, targets, self.separate_surfaces, agree)
        return hits, depth.distances(vertices, self.triangles, hits, rendered, targets), weight

    @cached_property
    def uv_ssim(self) -> UVSSIM | None:
        """The comparison with the neutral's texture, if there is a neutral."""
        if self.neutral is None:
            return None
        texture = torch.as_tensor(self.neutral.texture, device=self.device)
        return UVSSIM(self.data, self.neutral.corner_uvs, texture, self.neutral.confidence, self.recipe.slide_px)


class ViewOrder:
    """The order in which steps take views: each once before any comes again, and those of a step far apart.

    Gradients of views all around the head differ less from step to step than those of random views.

    Args:
        centres: of the cameras.
        seed: of the first view of each step, and of ties.
    """

    def __init__(self, centres: Float[np.ndarray, "N 3"], seed: int):
        self._distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        self._random = np.random.default_rng(seed)
        self._waiting: list[int] = []

    def take(self, count: int) -> list[int]:
        """Return the next `count` views, or all if there are fewer, sorted."""
        taken: list[int] = []
        while len(taken) < min(count, len(self._distance)):
            candidates = [view for view in self._waiting if view not in taken]
            if not candidates:
                self._waiting += [int(view) for view in self._random.permutation(len(self._distance))]
                continue
            apart = self._distance[candidates][:, taken].min(1) if taken else np.zeros(len(candidates))
            view = candidates[int(apart.argmax())]
            self._waiting.remove(view)
            taken.append(view)
        return sorted(taken)


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinMesh:
    """The vertices and triangles that carry free offsets, as rows of the skin."""

    triangles: Int[np.ndarray, "G 3"]
    points: Float[np.ndarray, "S 3"]  # of the template, metres
    edge_length_m: Float[np.ndarray, "S"]  # mean over each vertex' edges
    region: Int[np.ndarray, "S"]  # 0, or 1 + index into the recipe's regions

    @classmethod
    def from_model(cls, data: GNMData, recipe: Recipe) -> "SkinMesh":
        """Cut the skin out of the model's mesh and mark the recipe's regions."""
        skin = skin_vertices(data)
        triangles = skin_triangles(data.triangles, skin, len(data.template_vertex_positions))
        points = data.template_vertex_positions[skin]
        masks = offset_regions(data)
        region = np.zeros(len(skin), np.int64)
        for number, settings in enumerate(recipe.regions, start=1):
            region[grown(triangles, masks[settings.name][skin], _REGION_RINGS)] = number
        return cls(triangles=triangles, points=points, edge_length_m=spacing(triangles, points), region=region)
