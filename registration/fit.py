"""One fit: stages in order on one capture's targets."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.frames import MM_PER_M
from registration.geometry.large_steps import LargeSteps, normalised_laplacian, to_torch
from registration.losses import geometry, image, landmark
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import crossing_parts, vertex_classes
from registration.optimize import AdamBlock, AdamUniformBlock, Block, History, minimise
from registration.render.renderer import Renderer
from registration.stages import Recipe, Stage, rigid
from registration.start import Candidate, assess
from registration.targets.classes import ClassMap
from registration.types import Rendered, Targets
from registration.unknowns import Start, Unknowns, skin_topology, skin_vertices

# Surfaces of their own: a pixel that sees one where the target sees another compares nothing but classes.
_SEPARATE = ("left_eye", "right_eye", "mouth_interior")
_GREY = 0.25  # linear; what a texel shows before any view has been unwrapped to it
_TEXTURE_STEP = 0.5
_LEAST_DENSITY = 1e-3
_SETTLED_SHARE = 0.1  # of the last stage's steps, over which vertices must stand still


OnStep = Callable[[Stage, int], None]


@dataclass
class Outcome:
    """How the stages went. `motion_mm`: 95th percentile of vertex motion over the end of the last stage."""

    history: dict[str, History] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    motion_mm: float = float("inf")
    failure: str | None = None


class Fit:
    """The fitting problem of one capture: model, targets, unknowns, texture and gains."""

    def __init__(
        self,
        data: GNMData,
        model: GNM,
        pyramid: tuple[Targets, ...],
        mapping: ClassMap,
        schemes: Mapping[str, LandmarkScheme],
        corner_uvs: Float[np.ndarray, "F 3 2"],
        recipe: Recipe,
        seed: int,
    ):
        self.data, self.model, self.pyramid, self.recipe = data, model, pyramid, recipe
        self.device = model.template.device
        self.corner_uvs = corner_uvs
        classes = vertex_classes(data)[1] @ mapping.from_model
        self.renderer = Renderer(data.triangles, corner_uvs, classes, parts=crossing_parts(data), seed=seed)
        self.schemes = {name: scheme for name, scheme in schemes.items() if name in pyramid[0].landmarks}
        self.landmark_use: dict[str, np.ndarray] = {  # bool (L,)
            name: np.ones(len(scheme.indices), bool) for name, scheme in self.schemes.items()
        }
        self.texture = torch.full((recipe.texture_px, recipe.texture_px, 3), _GREY, device=self.device)
        self.gains = torch.zeros(len(pyramid[0].names), 3, 2, device=self.device)  # log gain and bias per channel
        self._textured = False
        self._random = np.random.default_rng(seed)
        self._order: list[int] = []
        self._surfaces = [mapping.names.index(name) for name in _SEPARATE if name in mapping.names]
        self._class_names = mapping.names
        self._read_topology()

    def _read_topology(self) -> None:
        """What the offsets' terms need of the mesh: once, for any start."""
        skin, count = skin_vertices(self.data), len(self.data.template_vertex_positions)
        self._skin_triangles, edge_list = skin_topology(self.data.triangles, skin, count)
        points = self.data.template_vertex_positions[skin]
        lengths = np.linalg.norm(points[edge_list[:, 0]] - points[edge_list[:, 1]], axis=1)
        self._edge_length = float(np.median(lengths))
        self._laplacian = to_torch(normalised_laplacian(self._skin_triangles, len(skin)), self.device)
        self._coupling = geometry.EdgeCoupling(
            edges=torch.as_tensor(edge_list, device=self.device),
            weights=torch.ones(len(edge_list), device=self.device),
        )

    def begin(self, start: Start, texture: Float[np.ndarray, "R R 3"] | None = None) -> None:
        """Set the unknowns, and the texture if one is known."""
        self.unknowns = Unknowns(self.model, self.data, start)
        if texture is not None:
            self.texture = torch.as_tensor(texture, device=self.device)
            self._textured = True

    def vertices(self) -> Float[Tensor, "V 3"]:
        with torch.no_grad():
            return self.unknowns.vertices(self.unknowns.skin_offsets())

    def run(self, stages: tuple[Stage, ...], outcome: Outcome, on_step: OnStep) -> None:
        """Run stages until one fails; fills `outcome`."""
        for stage in stages:
            begun = time.perf_counter()
            history, outcome.failure = self._run_stage(stage, outcome, on_step)
            outcome.history[stage.name] = history
            outcome.seconds[stage.name] = time.perf_counter() - begun
            if outcome.failure:
                outcome.failure = f"stage {stage.name}: {outcome.failure}"
                return

    def _run_stage(self, stage: Stage, outcome: Outcome, on_step: OnStep) -> tuple[History, str | None]:
        free = [name for name, _ in stage.free if name != "scale" or self.recipe.scale]
        steps = None
        if "offsets" in free:
            steps = LargeSteps(
                self._skin_triangles,
                len(self.unknowns.skin),
                edge_length_m=self._edge_length,
                smoothing_m=stage.smoothing_mm / MM_PER_M,
                device=self.device,
            )
        self.unknowns.free(free, steps)
        if stage.texture and not self._textured:
            self._unwrap_all(stage)
        blocks: list[Block] = []
        for name, rate in stage.free:
            if name == "offsets":
                blocks.append(AdamUniformBlock(self.unknowns[name], rate))
            elif name in free:
                blocks.append(AdamBlock([self.unknowns[name]], rate))
        watch_from = stage.steps - max(1, int(_SETTLED_SHARE * stage.steps))
        before: list[Tensor] = []

        def after(step: int) -> None:
            if step == watch_from - 1 or (step == 0 and watch_from == 0):
                before.append(self.vertices())
            on_step(stage, step)

        history, failure = minimise(blocks, lambda step: self._terms(stage, step), stage.steps, after)
        if before:
            motion = (self.vertices() - before[0]).norm(dim=-1) * MM_PER_M
            outcome.motion_mm = float(motion.quantile(0.95))
        self.unknowns.settle()
        return history, failure

    def _next_views(self, count: int) -> list[int]:
        """Views in a random order, each once before any comes again."""
        total = len(self.pyramid[0].names)
        count = min(count, total)
        while len(self._order) < count:
            self._order += [int(v) for v in self._random.permutation(total) if int(v) not in self._order]
        chosen, self._order = self._order[:count], self._order[count:]
        return sorted(chosen)

    def _terms(self, stage: Stage, step: int) -> dict[str, Tensor]:
        """The weighted terms of one step."""
        views = self._next_views(stage.views_per_step)
        batch = self.pyramid[stage.level].select(views, self.device)
        offsets = self.unknowns.skin_offsets()
        vertices = self.unknowns.vertices(offsets)
        colour = stage.weights.rgb > 0 or stage.texture
        rendered = self.renderer(vertices, self.texture if colour else None, batch.pixels)
        terms = self._image_terms(stage, rendered, batch, views)
        terms |= self._landmark_terms(stage, vertices, batch)
        return terms | self._prior_terms(stage, offsets)

    def _image_terms(self, stage: Stage, rendered: Rendered, batch: Targets, views: list[int]) -> dict[str, Tensor]:
        w = stage.weights
        agree = image.agreement(rendered, batch, self._surfaces)
        terms = {
            "normals": w.normals * image.normals(rendered, batch, agree, w.normal_truncation),
            "mask": w.mask * image.mask(rendered, batch),
            "classes": w.classes * image.classes(rendered, batch, self._class_weights(w.eye_classes)),
        }
        if stage.texture:
            self._update_gains(rendered, batch, agree, views)
        if w.rgb > 0:
            shown = self._expose(rendered, batch, views)
            terms["rgb"] = w.rgb * image.rgb_l1(shown, batch, agree)
            if w.ssim > 0:
                terms["ssim"] = w.ssim * image.rgb_ssim(shown, batch, agree)
        if stage.texture:
            self._update_texture(rendered, batch, agree, views)
        return terms

    def _class_weights(self, eyes: float) -> Tensor:
        return torch.tensor([eyes if "eye" in name else 1.0 for name in self._class_names], device=self.device)

    def _landmark_terms(self, stage: Stage, vertices: Tensor, batch: Targets) -> dict[str, Tensor]:
        terms = {}
        for name, scheme in self.schemes.items():
            points, seen = scheme.points(vertices), batch.landmarks[name]
            residual, counts = landmark.residuals(batch.pixels.cameras, points, seen, batch.px_per_head)
            weight = counts * torch.as_tensor(self.landmark_use[name], device=self.device)
            loss = landmark.robust(residual, weight, stage.weights.landmark_sigma_px)
            terms[f"landmarks {name}"] = stage.weights.landmarks * loss
        return terms

    def _prior_terms(self, stage: Stage, offsets: Tensor) -> dict[str, Tensor]:
        w, u = stage.weights, self.unknowns
        terms = {}
        if stage.frees("identity"):
            terms["identity"] = w.identity * geometry.prior(u["identity"])
        if stage.frees("expression"):
            terms["expression"] = w.expression * geometry.prior(u["expression"])
        if stage.frees("joints"):
            terms["joints"] = w.rotations * u["joints"].square().sum()
        if stage.frees("eyes"):
            eyes = u["eyes"]
            terms["eyes"] = w.eyes * eyes[:, :3].square().sum() + w.eye_scale * eyes[:, 3].square().sum()
        if stage.frees("offsets"):
            change = offsets - u.reference_offsets
            terms["offset l2"] = w.offset_l2 * geometry.l2(change)
            terms["offset laplacian"] = w.offset_laplacian * geometry.laplacian(change, self._laplacian)
            terms["offset coupling"] = w.offset_coupling * self._coupling(change)
        return terms

    def _exposure(self, batch: Targets, views: list[int]) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """Gain and bias of every pixel's camera."""
        gains = self.gains[views][batch.pixels.view.long()]
        return gains[..., 0].exp(), gains[..., 1]

    def _expose(self, rendered: Rendered, batch: Targets, views: list[int]) -> Rendered:
        """The rendered colours as each camera would record them."""
        gain, bias = self._exposure(batch, views)
        return replace(rendered, rgb=rendered.rgb * gain + bias)

    @torch.no_grad()
    def _update_gains(self, rendered: Rendered, batch: Targets, agree: Tensor, views: list[int]) -> None:
        """Closed form: per view and channel, the gain and bias that map rendered to seen colours best."""
        weight = (batch.rgb_weight * agree)[:, None]
        view = batch.pixels.view.long()

        def total(value: Tensor) -> Tensor:
            return value.new_zeros(len(views), value.shape[1]).index_add(0, view, value)

        count = total(weight).clamp_min(1e-6)
        r, t = (total(c * weight) / count for c in (rendered.rgb, batch.rgb))
        variance = total(rendered.rgb.square() * weight) / count - r.square()
        covariance = total(rendered.rgb * batch.rgb * weight) / count - r * t
        # Priors: gain 1 +- 0.1, bias 0 +- 0.02, against pixel noise of 0.05 over some hundred independent patches.
        noise = 0.05**2 / 100
        gain_prior, bias_prior = noise / 0.1**2, noise / 0.02**2
        shrink = bias_prior / (1 + bias_prior)
        gain = (covariance + shrink * r * t + gain_prior) / (variance + shrink * r.square() + gain_prior)
        bias = (t - gain * r) / (1 + bias_prior)
        self.gains[views] = torch.stack([gain.clamp(0.3, 3.0).log(), bias], -1)
        # One common gain belongs to the texture.
        self.gains[..., 0] -= self.gains[..., 0].mean(0)

    @torch.no_grad()
    def _update_texture(self, rendered: Rendered, batch: Targets, agree: Tensor, views: list[int]) -> None:
        """Closed form: move every texel half way to what the views of this step saw of it."""
        gain, bias = self._exposure(batch, views)
        weight = batch.rgb_weight.square() * agree
        change = (batch.rgb - bias) / gain - rendered.rgb
        total, density = self.renderer.unwrap(self.vertices(), change, weight, batch.pixels, self.texture.shape[0])
        step = torch.where(density > _LEAST_DENSITY, _TEXTURE_STEP / density.clamp_min(_LEAST_DENSITY), 0.0)
        self.texture = (self.texture + step[..., None] * total).clamp(0, 1)

    @torch.no_grad()
    def _unwrap_all(self, stage: Stage) -> None:
        """A first texture: the weighted mean of all views."""
        size, vertices = self.texture.shape[0], self.vertices()
        total, density = torch.zeros_like(self.texture), torch.zeros(size, size, device=self.device)
        for first in range(0, len(self.gains), stage.views_per_step):
            views = list(range(first, min(first + stage.views_per_step, len(self.gains))))
            batch = self.pyramid[stage.level].select(views, self.device)
            rendered = self.renderer(vertices, None, batch.pixels)
            weight = batch.rgb_weight.square() * image.agreement(rendered, batch, self._surfaces)
            t, d = self.renderer.unwrap(vertices, batch.rgb, weight, batch.pixels, size)
            total, density = total + t, density + d
        seen = density > _LEAST_DENSITY
        mean = total / density.clamp_min(_LEAST_DENSITY)[..., None]
        fill = mean[seen].mean(0) if seen.any() else torch.full((3,), _GREY, device=self.device)
        self.texture = torch.where(seen[..., None], mean, fill)
        self._textured = True

    def assess(self, start: Start) -> Candidate:
        """How well a start covers the coarsest targets, all views."""
        self.begin(start)
        batch = self.pyramid[-1].select(range(len(self.gains)), self.device)
        with torch.no_grad():
            return assess(start, self.renderer(self.vertices(), None, batch.pixels), batch)

    def refine(self, start: Start) -> Start:
        """The start moved as a rigid body, and scaled if the recipe may, by images alone."""
        self.begin(start)
        self._run_stage(rigid(len(self.pyramid) - 1), Outcome(), lambda stage, step: None)
        rotation, unknowns = self.unknowns.rotation().detach().cpu().numpy(), self.unknowns
        position, scale = unknowns["position"].detach().cpu().numpy(), float(unknowns["scale"].detach().exp())
        return replace(start, rotation=rotation, position=position, scale=scale)

    def picture(self, views: list[int]) -> tuple[Targets, Rendered]:
        """Some views at the finest level, and what the fit shows there, exposed as their cameras would."""
        batch = self.pyramid[0].select(views, self.device)
        with torch.no_grad():
            rendered = self.renderer(self.vertices(), self.texture, batch.pixels)
            return batch, self._expose(rendered, batch, views)
