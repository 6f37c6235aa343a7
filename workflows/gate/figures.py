"""The figures of a registration that the gate's rules use, read from its manifest in milliseconds (docs/gate.md)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from registration.evaluate.names import BEYOND_KEY

if TYPE_CHECKING:  # they load numeric libraries
    from registration.storage.registration_folder import RegistrationManifest
    from registration.types import Status


@dataclass(frozen=True, kw_only=True)
class FigureKind:
    """One kind of figure, as tables and reasons show it. Larger values are worse."""

    title: str
    unit: str
    meaning: str
    noise: float  # least spread of good registrations that a calibration assumes: smaller differences mean nothing
    digits: int = 1

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        number = f"{value:.{self.digits}f}"
        return f"{number}{self.unit}" if self.unit == "°" else f"{number} {self.unit}".rstrip()


@dataclass(frozen=True, kw_only=True)
class GateFigures:
    """The figures of one registration; None: not measured. `FIGURES` describes them."""

    scan_mm: float | None = None
    landmarks_px: float | None = None
    worst_landmarks_px: float | None = None
    far_landmarks_percent: float | None = None
    silhouette_px: float | None = None
    worst_silhouette_px: float | None = None
    labels_percent: float | None = None
    worst_labels_percent: float | None = None
    normals_deg: float | None = None
    worst_normals_deg: float | None = None
    colour_levels: float | None = None
    worst_colour_levels: float | None = None
    depth_mm: float | None = None
    intersections_mm: float | None = None
    intersecting_vertices: float | None = None
    reversed_skin_mm2: float | None = None
    untrusted_percent: float | None = None
    warnings: float | None = None
    motion_mm: float | None = None
    identity_sigmas: float | None = None
    expression_sigmas: float | None = None
    offset_sigmas: float | None = None
    size_percent: float | None = None
    neutral_offsets_mm: float | None = None
    neutral_texture: float | None = None

    def known(self) -> dict[str, float]:
        """Return name -> value of the measured ones."""
        values = ((item.name, getattr(self, item.name)) for item in fields(self))
        return {name: value for name, value in values if value is not None}


FIGURES: Mapping[str, FigureKind] = {
    "scan_mm": FigureKind(
        title="distance from the scan",
        unit="mm",
        meaning="mean distance of the scan's face from the mesh",
        noise=0.02,
        digits=2,
    ),
    "landmarks_px": FigureKind(
        title="landmarks", unit="px", meaning="median distance of the landmarks; the head is 512 px high", noise=0.1
    ),
    "worst_landmarks_px": FigureKind(
        title="landmarks in the worst view", unit="px", meaning="the same in the view where it is largest", noise=0.2
    ),
    "far_landmarks_percent": FigureKind(
        title="landmarks far off", unit="%", meaning="landmarks more than 10 mm from those of the mesh", noise=1.0
    ),
    "silhouette_px": FigureKind(
        title="silhouette", unit="px", meaning="mean distance of the outlines; the head is 512 px high", noise=0.1
    ),
    "worst_silhouette_px": FigureKind(
        title="silhouette in the worst view", unit="px", meaning="the same in the view where it is largest", noise=0.2
    ),
    "labels_percent": FigureKind(title="labels", unit="%", meaning="pixels whose label is another one", noise=0.2),
    "worst_labels_percent": FigureKind(
        title="labels in the worst view", unit="%", meaning="the same in the view where it is largest", noise=0.4
    ),
    "normals_deg": FigureKind(title="normals", unit="°", meaning="median angle between the normals", noise=0.2),
    "worst_normals_deg": FigureKind(
        title="normals in the worst view", unit="°", meaning="the same in the view where it is largest", noise=0.4
    ),
    "colour_levels": FigureKind(
        title="colour", unit="levels", meaning="mean difference of the colours, of 255 sRGB levels", noise=0.3
    ),
    "worst_colour_levels": FigureKind(
        title="colour in the worst view", unit="levels", meaning="the same in the view where it is largest", noise=0.6
    ),
    "depth_mm": FigureKind(
        title="depth", unit="mm", meaning="median distance of the depth maps from the skin", noise=0.02, digits=2
    ),
    "intersections_mm": FigureKind(
        title="self-intersection",
        unit="mm",
        meaning="largest depth of a part in another beyond the template's",
        noise=0.1,
    ),
    "intersecting_vertices": FigureKind(
        title="intersecting vertices",
        unit="",
        meaning="vertices that lie too deep in another part",
        noise=10.0,
        digits=0,
    ),
    "reversed_skin_mm2": FigureKind(
        title="reversed skin", unit="mm²", meaning="skin of eyes, mouth, nostrils and ears turned inside out", noise=0.3
    ),
    "untrusted_percent": FigureKind(
        title="views not trusted", unit="%", meaning="views that disagree with the others", noise=1.0, digits=0
    ),
    "warnings": FigureKind(
        title="warnings", unit="", meaning="warnings about the capture's files", noise=0.3, digits=0
    ),
    "motion_mm": FigureKind(
        title="motion at the end",
        unit="mm",
        meaning="by which the fit still moved over its last steps",
        noise=0.002,
        digits=3,
    ),
    "identity_sigmas": FigureKind(
        title="identity",
        unit="standard deviations",
        meaning="root mean square of the coefficients",
        noise=0.03,
        digits=2,
    ),
    "expression_sigmas": FigureKind(
        title="expression",
        unit="standard deviations",
        meaning="root mean square of the coefficients",
        noise=0.03,
        digits=2,
    ),
    "offset_sigmas": FigureKind(
        title="offsets",
        unit="standard deviations",
        meaning="root mean square of the offsets from the model, relative to its spread at each vertex",
        noise=0.01,
        digits=2,
    ),
    "size_percent": FigureKind(title="size", unit="%", meaning="difference of the size from the model's", noise=0.5),
    "neutral_offsets_mm": FigureKind(
        title="difference from the neutral",
        unit="mm",
        meaning="root mean square between the offsets",
        noise=0.05,
        digits=2,
    ),
    "neutral_texture": FigureKind(
        title="texture unlike the neutral's",
        unit="",
        meaning="dissimilarity of the textures: 0 equal, about 1 unrelated",
        noise=0.01,
        digits=2,
    ),
}
_RESIDUALS = ("landmarks_px", "silhouette_px", "labels_percent", "normals_deg", "colour_levels", "depth_mm")


@dataclass(frozen=True, kw_only=True)
class Assessed:
    """What the gate judges: one registration, without its arrays."""

    content_id: str
    status: "Status"
    reason: str
    is_neutral: bool  # not registered from a neutral
    figures: GateFigures


def assess(manifest: "RegistrationManifest") -> Assessed:
    """Return what the gate judges of a registration."""
    return Assessed(
        content_id=manifest.content_id,
        status=manifest.status,
        reason=manifest.reason,
        is_neutral="neutral" not in manifest.inputs,
        figures=read_figures(manifest.figures),
    )


def read_figures(figures: Mapping[str, Any]) -> GateFigures:
    """Return the gate's figures from those of a manifest; what is missing or no finite number is None."""

    def at(*path: str) -> float | None:
        value: Any = figures
        for name in path:
            value = value.get(name) if isinstance(value, Mapping) else None
        return _number(value)

    views = _mapping(_mapping(figures.get("residuals")).get("views"))
    values: dict[str, float | None] = {name: at("residuals", "overall", name) for name in _RESIDUALS}
    for name in _RESIDUALS[:-1]:
        values[f"worst_{name}"] = _largest([_mapping(view).get(name) for view in views.values()])
    if values["landmarks_px"] is None:
        values["landmarks_px"] = _largest([*_mapping(figures.get("landmark_residual_px")).values()])
    pairs = _mapping(_mapping(figures.get("intersections")).get("pairs"))
    # Of the tongue little is seen: in a closed mouth it may lie in the gums of a face that is right everywhere.
    counted = [_mapping(row) for name, row in pairs.items() if not str(name).startswith("tongue")]
    count = len(views)
    untrusted = len(_mapping(figures.get("views_not_trusted")))
    return GateFigures(
        **values,
        scan_mm=at("scan_to_mesh", "face", "mean_mm"),
        far_landmarks_percent=at("far_landmarks", "percent"),
        intersections_mm=_largest([row.get("max_excess_mm") for row in counted]),
        intersecting_vertices=_sum([row.get(BEYOND_KEY) for row in counted]),
        reversed_skin_mm2=at("reversed_skin", "area_mm2"),
        untrusted_percent=100 * untrusted / count if count else None,
        warnings=float(len(figures["warnings"])) if isinstance(figures.get("warnings"), list | tuple) else 0.0,
        motion_mm=at("motion_mm"),
        identity_sigmas=at("from_model", "identity_sigmas"),
        expression_sigmas=at("from_model", "expression_sigmas"),
        offset_sigmas=at("from_model", "offset_sigmas"),
        size_percent=at("from_model", "size_percent"),
        neutral_offsets_mm=at("from_neutral", "offsets_mm"),
        neutral_texture=at("from_neutral", "texture"),
    )


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: Any) -> float | None:
    known = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if known else None


def _largest(values: Sequence[Any]) -> float | None:
    return max((number for value in values if (number := _number(value)) is not None), default=None)


def _sum(values: Sequence[Any]) -> float | None:
    numbers = [number for value in values if (number := _number(value)) is not None]
    return sum(numbers) if numbers else None
