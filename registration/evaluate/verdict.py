"""The verdict on a registration from its figures: whether to use it, to look at it, or to discard it.

The status says how the optimization ended; the verdict says how well the mesh agrees with what was measured. The limits
are documented in docs/evaluation.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from registration.evaluate.names import RESIDUALS, REVERSED_SKIN_MM2, Level
from registration.types import Status

_ORDER: tuple[Level, ...] = ("good", "look", "wrong")


@dataclass(frozen=True, kw_only=True)
class Limit:
    """Values above which a figure asks for a look, or is wrong."""

    look: float
    wrong: float = float("inf")

    def level(self, value: float) -> Level:
        """Return the level of a value."""
        return "wrong" if value > self.wrong else "look" if value > self.look else "good"


# Statistics of the distance of the scan's face from the mesh, mm.
SCAN_LIMITS = {
    "median_mm": Limit(look=0.2, wrong=0.6),
    "mean_mm": Limit(look=0.4, wrong=0.8),
    "p95_mm": Limit(look=2.0),  # inside an open mouth, where only the model's teeth are known, 1.5 mm is usual
}
# Residuals in the images; they count where no scan measures the face.
RESIDUAL_LIMITS = {
    "silhouette_px": Limit(look=1.5, wrong=5.0),
    "normals_deg": Limit(look=5.0, wrong=15.0),
    "depth_mm": Limit(look=0.6, wrong=2.0),
    "colour_levels": Limit(look=10.0),
    "labels_percent": Limit(look=5.0),
    "landmarks_px": Limit(look=5.0, wrong=12.0),
}
LEAST_COVERAGE = 0.5  # of the head by depths that were made from the photographs
INTERSECTION_LIMIT_MM = Limit(look=2.0)
REVERSED_LIMIT_MM2 = Limit(look=REVERSED_SKIN_MM2)
NOT_TRUSTED_LIMIT = Limit(look=0.0, wrong=0.5)  # fraction of the views
_SCAN_PHRASES = {
    "median_mm": "half of the scan's face lies more than {:.2f} mm from the mesh",
    "mean_mm": "the scan's face lies {:.2f} mm from the mesh on average",
    "p95_mm": "5 % of the scan's face lie more than {:.1f} mm from the mesh",
}


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A level and the reasons for it, phrases without a full stop: those of the worst level first."""

    level: Level
    reasons: tuple[str, ...]

    @property
    def figure(self) -> dict[str, Any]:
        """The manifest's figure."""
        return {"level": self.level, "reasons": list(self.reasons)}


def judge(status: Status, figures: Mapping[str, Any]) -> Verdict:
    """Return the verdict on a registration.

    Args:
        status: of the registration.
        figures: of its manifest. What is missing is not judged, but without a distance from a scan and without
            residuals nothing is known and the level is at least "look".
    """
    found: list[tuple[Level, str]] = []
    if status == "failed":
        found.append(("wrong", "the fit failed"))
    elif status == "stopped":
        found.append(("look", "the fit was stopped before the mesh came to rest"))
    face = _mapping(_mapping(figures.get("scan_to_mesh")).get("face"))
    residuals = _mapping(_mapping(figures.get("residuals")).get("overall"))
    if face.get("mean_mm") is not None:
        found += _scan(face)
    elif residuals:
        found += [*_residuals(residuals), *_made(_mapping(figures.get("made")))]
    else:
        found.append(("look", "nothing measures the mesh: there is neither a scan of the face nor any image residual"))
    found += _views(figures) + _intersections(figures) + _reversed_skin(figures)
    if warnings := figures.get("warnings"):
        found.append(
            (
                "look",
                "1 warning about the capture" if len(warnings) == 1 else f"{len(warnings)} warnings about the capture",
            )
        )
    worst = max((_ORDER.index(level) for level, _ in found), default=0)
    ranked = sorted(found, key=lambda item: -_ORDER.index(item[0]))
    kept = [reason for level, reason in ranked if level != "good" or not worst]
    return Verdict(level=_ORDER[worst], reasons=tuple(kept))


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _scan(face: Mapping[str, Any]) -> list[tuple[Level, str]]:
    levels = {
        name: limit.level(face[name]) for name, limit in SCAN_LIMITS.items() if isinstance(face.get(name), int | float)
    }
    off: list[tuple[Level, str]] = [
        (level, _SCAN_PHRASES[name].format(face[name])) for name, level in levels.items() if level != "good"
    ]
    return off or [("good", f"the scan's face lies {face['mean_mm']:.2f} mm from the mesh on average")]


def _residuals(residuals: Mapping[str, Any]) -> list[tuple[Level, str]]:
    known = {name: residuals[name] for name in RESIDUAL_LIMITS if isinstance(residuals.get(name), int | float)}
    shown = {name: f"{RESIDUALS[name].title} {RESIDUALS[name].text(value)}" for name, value in known.items()}
    off: list[tuple[Level, str]] = [
        (level, f"{shown[name]} off in the images (more than {RESIDUALS[name].text(RESIDUAL_LIMITS[name].look)})")
        for name, value in known.items()
        if (level := RESIDUAL_LIMITS[name].level(value)) != "good"
    ]
    if not {"normals_deg", "colour_levels"} & known.keys():
        off.append(("look", "neither normals nor colours were compared: nothing measures the surface itself"))
    return off or [("good", f"no scan; in the images {', '.join(shown.values())} off")]


def _made(made: Mapping[str, Any]) -> list[tuple[Level, str]]:
    """What the residuals are worth if the channels that they compare with were made from the photographs."""
    channels = made.get("channels")
    if not channels:
        return []
    coverage = made.get("coverage")
    if "normals" in channels and isinstance(coverage, int | float) and coverage < LEAST_COVERAGE:
        return [("look", f"stereo found depths on {coverage:.0%} of the head only: the rest is the model's guess")]
    return [("good", f"{', '.join(map(str, channels))} were made from the photographs")]


def _views(figures: Mapping[str, Any]) -> list[tuple[Level, str]]:
    suspects = _mapping(figures.get("views_not_trusted"))
    count = len(_mapping(_mapping(figures.get("residuals")).get("views"))) or 2 * len(suspects)
    if not suspects:
        return []
    names = ", ".join(suspects)
    disagree = "disagrees" if len(suspects) == 1 else "disagree"
    return [(NOT_TRUSTED_LIMIT.level(len(suspects) / count), f"{names} {disagree} with the other views")]


def _intersections(figures: Mapping[str, Any]) -> list[tuple[Level, str]]:
    pairs = _mapping(_mapping(figures.get("intersections")).get("pairs"))
    # Of the tongue little is seen: in a closed mouth it may lie 4 mm in the gums of a face that is right everywhere.
    excess = {
        name: row["max_excess_mm"]
        for name, row in pairs.items()
        if row.get("max_excess_mm") is not None and not name.startswith("tongue")
    }
    name = max(excess, key=lambda pair: excess[pair], default=None)
    if name is None or INTERSECTION_LIMIT_MM.level(excess[name]) == "good":
        return []
    return [("look", f"parts of the mesh lie up to {excess[name]:.1f} mm inside one another ({name})")]


def _reversed_skin(figures: Mapping[str, Any]) -> list[tuple[Level, str]]:
    reversed_skin = _mapping(figures.get("reversed_skin"))
    area = reversed_skin.get("area_mm2")
    if not isinstance(area, int | float) or REVERSED_LIMIT_MM2.level(area) == "good":
        return []
    places = ", ".join(_mapping(reversed_skin.get("places")))
    return [("look", f"{area:.0f} mm\u00b2 of the skin are turned inside out ({places})")]
