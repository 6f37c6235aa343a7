"""One fit: stages in order on one capture's targets."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.fit.appearance import Appearance
from registration.fit.confidence import vertex_confidence
from registration.fit.initialization import Candidate, assess
from registration.fit.optimizer import AdamBlock, AdamUniformBlock, Block, History, minimise
from registration.fit.recipes import Lengths, Recipe, Stage, rigid
from registration.fit.variables import Start, Unknowns, skin_topology, skin_vertices
from registration.fit.view_weights import HEAD_PX, Trust, ViewErrors, view_errors
from registration.frames import MM_PER_M
from registration.geometry.large_steps import LargeSteps, normalised_laplacian, spacing
from registration.losses import image, landmark, regularization
from registration.losses.self_intersection import OF_THE_TONGUE, SelfIntersection
from registration.losses.uv_ssim import TextureSlide
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import crossing_parts, offset_regions, vertex_classes
from registration.render.renderer import Renderer
from registration.targets.classes import ClassMap
from registration.types import Registration, Rendered, Targets

# Surfaces of their own: a pixel that sees one where the target sees another compares nothing but classes.
_SEPARATE = ("left_eye", "right_eye", "mouth_interior")
_SETTLED_SHARE = 0.1  # of the last stage's steps, over which vertices must stand still
_CONTACTS_EVERY = 10  # steps, after which parts that may touch are looked up anew
_LONGEST_STEP_MM = 2.0  # of a region with a pace of its own, if the stage itself steps no further
_REGION_RINGS = 2  # around a region that belong to it, so that its rim can follow


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
        self.renderer = Renderer(
            data.triangles,
            corner_uvs,
            classes,
            parts=crossing_parts(data) * bool(recipe.edge_samples),  # one part alone crosses nothing
            edge_samples=recipe.edge_samples,
            seed=seed,
        )
        self.schemes = {name: scheme for name, scheme in schemes.items() if name in pyramid[0].landmarks}
        self.landmark_use: dict[str, np.ndarray] = {  # bool (L,)
            name: np.ones(len(scheme.indices), bool) for name, scheme in self.schemes.items()
        }
        self.appearance = Appearance(self.renderer, recipe.texture_px, len(pyramid[0].names), self.device)
        self.trust = Trust.full(len(pyramid[0].names))
        self._contacts = SelfIntersection(data, self.device)
        self._slide: TextureSlide | None = None
        self._random = np.random.default_rng(seed)
        self._order: list[int] = []
        self._surfaces = [mapping.names.index(name) for name in _SEPARATE if name in mapping.names]
        self._class_names = mapping.names
        self._read_topology()

    def _read_topology(self) -> None:
        """What the offsets' terms need of the mesh: once, for any start."""
        skin, count = skin_vertices(self.data), len(self.data.template_vertex_positions)
        self._skin_triangles, _ = skin_topology(self.data.triangles, skin, count)
        self._skin_points = self.data.template_vertex_positions[skin]
        self._spacing = spacing(self._skin_triangles, self._skin_points)
        near = normalised_laplacian(self._skin_triangles, len(skin)) != 0
        found = offset_regions(self.data)
        self._region = np.zeros(len(skin), np.int64)  # 0 is the rest
        for number, region in enumerate(self.recipe.regions, start=1):
            members = found[region.name][skin]
            for _ in range(_REGION_RINGS):
                members = members | (near @ members)
            self._region[members] = number

    def begin(self, start: Start, neutral: Registration | None = None) -> None:
        """Set the unknowns and, for an expression, what its neutral tells of texture and sliding."""
        self.unknowns = Unknowns(self.model, self.data, start)
        if neutral is not None:
            self.appearance.begin(neutral.texture)
            reference = torch.as_tensor(neutral.texture, device=self.device)
            self._slide = TextureSlide(
                self.data, neutral.corner_uvs, reference, neutral.confidence, self.recipe.slide_px
            )

    def vertices(self) -> Float[Tensor, "V 3"]:
        with torch.no_grad():
            return self.unknowns.vertices(self.unknowns.skin_offsets())

    def run(self, stages: tuple[Stage, ...], outcome: Outcome, on_step: OnStep) -> None:
        """Run stages until one fails; fills `outcome`. Views are judged before the first and after each stage."""
        self.trust = Trust.of(self.view_errors())
        for stage in stages:
            begun = time.perf_counter()
            history, outcome.failure = self._run_stage(stage, outcome, on_step)
            outcome.history[stage.name] = history
            outcome.seconds[stage.name] = time.perf_counter() - begun
            if outcome.failure:
                outcome.failure = f"stage {stage.name}: {outcome.failure}"
                return
            self.trust = Trust.of(self.view_errors())

    def view_errors(self) -> ViewErrors:
        """How far each view is from the mesh, at the coarsest level."""
        targets = self.pyramid[-1].select(range(len(self.trust.geometry)), self.device)
        vertices = self.vertices()
        with torch.no_grad():
            rendered = self.renderer(vertices, None, targets.pixels)
        distances = list(self._landmark_residuals(vertices).values())
        landmark_px = (
            torch.cat(distances, 1).nanmedian(1).values
            if distances
            else torch.full((len(self.trust.geometry),), torch.nan)
        )
        return view_errors(rendered, targets, landmark_px)

    def _landmark_residuals(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, "N L"]]:
        """Per scheme, px at 512 px of head height; NaN where not seen or not used."""
        finest, found = self.pyramid[0], {}
        for name, scheme in self.schemes.items():
            points = scheme.points(vertices)
            distance, counts = landmark.residuals(
                finest.pixels.cameras, points, finest.landmarks[name].to(self.device), finest.px_per_head
            )
            used = (counts > 0) & torch.as_tensor(self.landmark_use[name], device=self.device)
            found[name] = torch.where(used, distance, torch.nan)
        return found

    def landmark_misfits(self, solved: Mapping[str, Float[np.ndarray, "L 3"]]) -> dict[str, float]:
        """Per scheme, how far the used landmarks lie from their points on the mesh: the median, px at 512 px of head.

        `solved` are triangulated, world, metres, NaN where unseen: what all views say together. Each alone is off by
        its own noise, however well the mesh fits.
        """
        finest, mesh, found = self.pyramid[0], self.vertices().double().cpu().numpy(), {}
        for name, scheme in self.schemes.items():
            points = scheme.points(mesh)
            distance = np.linalg.norm(points - solved[name], axis=1)[self.landmark_use[name]]
            depths = [camera.project(points.mean(0)[None])[1][0] for camera in finest.pixels.cameras]
            focals = [camera.intrinsics[0, 0] for camera in finest.pixels.cameras]
            px_per_m = float(np.median(np.divide(focals, depths))) * HEAD_PX / finest.px_per_head
            seen = distance[np.isfinite(distance)]
            found[name] = float(np.median(seen)) * px_per_m if len(seen) else float("nan")
        return found

    def _run_stage(self, stage: Stage, outcome: Outcome, on_step: OnStep) -> tuple[History, str | None]:
        free = [name for name, _ in stage.free if name != "scale" or self.recipe.scale]
        steps = self._bend(stage.lengths) if "offsets" in free and stage.lengths else None
        self.unknowns.free(free, steps)
        if stage.texture and not self.appearance.known:
            self.appearance.unwrap(self.vertices(), self._all_views(stage))
        watch_from = stage.steps - max(1, int(_SETTLED_SHARE * stage.steps))
        before: list[Tensor] = []

        def after(step: int) -> None:
            if step == watch_from - 1 or (step == 0 and watch_from == 0):
                before.append(self.vertices())
            on_step(stage, step)

        history, failure = minimise(
            self._blocks(stage, free), lambda step: self._terms(stage, step), stage.steps, after
        )
        if before:
            motion = (self.vertices() - before[0]).norm(dim=-1) * MM_PER_M
            outcome.motion_mm = float(motion.quantile(0.95))
        self.unknowns.settle()
        return history, failure

    def _bend(self, lengths: Lengths) -> LargeSteps:
        """The preconditioner and the penalties of a stage's lengths, region by region."""
        times = np.array([1.0, *(region.length for region in self.recipe.regions)])[self._region]
        smoothing = times * lengths.smoothing_mm / MM_PER_M
        if lengths.smoothing_mm > 0:  # less than an edge is no smoothing, and the scalp's are long
            smoothing = np.maximum(smoothing, self._spacing)
        self._elasticity = regularization.Elasticity(
            self._skin_triangles,
            self._skin_points,
            half_gain_m=times * lengths.half_gain_mm / MM_PER_M,
            decay_m=np.full(len(times), lengths.decay_mm / MM_PER_M),
            device=self.device,
        )
        return LargeSteps(
            self._skin_triangles,
            len(times),
            edge_length_m=self._spacing,
            smoothing_m=smoothing,
            device=self.device,
        )

    def _blocks(self, stage: Stage, free: Sequence[str]) -> list[Block]:
        blocks: list[Block] = []
        for name, rate in stage.free:
            if name == "offsets":
                groups = torch.as_tensor(self._region, device=self.device)
                fastest = max(1.0, _LONGEST_STEP_MM / MM_PER_M / rate.start)
                pace = (1.0, *(min(region.pace, fastest) for region in self.recipe.regions))
                blocks.append(AdamUniformBlock(self.unknowns[name], rate, groups=groups, pace=pace))
            elif name in free:
                blocks.append(AdamBlock([self.unknowns[name]], rate))
        return blocks

    def _all_views(self, stage: Stage) -> list[tuple[Targets, Tensor]]:
        """All views in batches, and where they agree with the mesh as it is."""
        found, count, vertices = [], len(self.trust.colour), self.vertices()
        for first in range(0, count, stage.views_per_step):
            views = list(range(first, min(first + stage.views_per_step, count)))
            batch = self.trust.applied(self.pyramid[stage.level].select(views, self.device), views)
            with torch.no_grad():
                rendered = self.renderer(vertices, None, batch.pixels)
            found.append((batch, image.agreement(rendered, batch, self._surfaces)))
        return found

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
        batch = self.trust.applied(self.pyramid[stage.level].select(views, self.device), views)
        offsets = self.unknowns.skin_offsets()
        vertices = self.unknowns.vertices(offsets)
        colour = stage.weights.rgb > 0 or stage.texture
        rendered = self.renderer(vertices, self.appearance.texture if colour else None, batch.pixels)
        terms = self._image_terms(stage, rendered, batch, views)
        terms |= self._landmark_terms(stage, vertices, batch)
        terms |= self._contact_terms(stage, step, offsets)
        if stage.weights.slide > 0 and self._slide is not None:
            even = replace(batch, rgb=self.appearance.corrected(batch, views))
            terms["slide"] = stage.weights.slide * self._slide(vertices, even)
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
            self.appearance.fit_exposures(rendered, batch, agree, views)
        if w.rgb > 0:
            shown = self.appearance.expose(rendered, batch, views)
            terms["rgb"] = w.rgb * image.rgb_l1(shown, batch, agree)
            if w.ssim > 0:
                terms["ssim"] = w.ssim * image.rgb_ssim(shown, batch, agree)
        if stage.texture:
            self.appearance.improve(self.vertices(), rendered, batch, agree, views)
        return terms

    def _contact_terms(self, stage: Stage, step: int, offsets: Tensor) -> dict[str, Tensor]:
        w = stage.weights
        if not (w.contacts or w.tongue):
            return {}
        touching = self.unknowns.yielding(offsets)
        if step % _CONTACTS_EVERY == 0:
            if step == 0 or stage.frees("identity"):  # else the head at rest is the one of step 0
                # How a person's tongue fills the mouth at rest is the model's own making, and seen by nobody.
                self._contacts.accept(self.unknowns.at_rest(), OF_THE_TONGUE)
            self._contacts.refresh(touching)
        found = self._contacts(touching).items()
        return {f"contact {pair}": (w.tongue if pair in OF_THE_TONGUE else w.contacts) * cost for pair, cost in found}

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
            terms["identity"] = w.identity * regularization.prior(u["identity"])
        if stage.frees("expression"):
            terms["expression"] = w.expression * regularization.prior(u["expression"])
        if stage.frees("joints"):
            terms["joints"] = w.rotations * u["joints"].square().sum()
        if stage.frees("eyes"):
            eyes = u["eyes"]
            terms["eyes"] = w.eyes * eyes[:, :3].square().sum() + w.eye_scale * eyes[:, 3].square().sum()
        if stage.frees("offsets"):
            for name, penalty in self._elasticity(offsets - u.reference_offsets).items():
                terms[name] = w.offsets * penalty
        return terms

    def assess(self, start: Start) -> Candidate:
        """How well a start covers the coarsest targets, all views."""
        self.begin(start)
        batch = self.pyramid[-1].select(range(len(self.trust.geometry)), self.device)
        with torch.no_grad():
            return assess(start, self.renderer(self.vertices(), None, batch.pixels), batch)

    def refine(self, start: Start) -> Start:
        """The start moved as a rigid body, and scaled if the recipe may, by images alone."""
        self.begin(start)
        self._run_stage(rigid(len(self.pyramid) - 1), Outcome(), lambda stage, step: None)
        rotation, unknowns = self.unknowns.rotation().detach().cpu().numpy(), self.unknowns
        position, scale = unknowns["position"].detach().cpu().numpy(), float(unknowns["scale"].detach().exp())
        return replace(start, rotation=rotation, position=position, scale=scale)

    def confidence(self) -> Float[np.ndarray, "V"]:
        """Of every vertex, in [0, 1): see `vertex_confidence`."""
        trusted = [v for v in range(len(self.trust.geometry)) if self.trust.geometry[v] > 0.5]
        groups = [trusted[first : first + 4] for first in range(0, len(trusted), 4)]
        drawn = (self.picture(views) for views in groups)
        return vertex_confidence(self.vertices().cpu().numpy(), self.data.triangles, drawn)

    def picture(self, views: list[int]) -> tuple[Targets, Rendered]:
        """Some views at the finest level, and what the fit shows there, exposed as their cameras would."""
        batch = self.pyramid[0].select(views, self.device)
        with torch.no_grad():
            rendered = self.renderer(self.vertices(), self.appearance.texture, batch.pixels)
            return batch, self.appearance.expose(rendered, batch, views)
