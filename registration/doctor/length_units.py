"""The unit of a world, from the size of what is in it."""

from registration.doctor.findings import Finding, FindingError
from registration.doctor.fixes import scaled_world
from registration.doctor.mesh_frame import UNITS
from registration.types import Capture


def plausible_units(extent: float, limits_m: tuple[float, float]) -> list[str]:
    """The units in which an extent in units of the world lies between two lengths."""
    return [name for name, unit in UNITS.items() if limits_m[0] <= extent * unit <= limits_m[1]]


def wrong_unit(
    capture: Capture, believed: str, expected: str, evidence: str, *, extent: float, limits_m: tuple[float, float]
) -> FindingError:
    """The refusal of a world that is not in metres.

    Args:
        capture: the capture.
        believed: what is wrong.
        expected: how large what was measured should be.
        evidence: how large it is.
        extent: the same, in units of the world.
        limits_m: what it is for most people; names the unit.
    """
    names = plausible_units(extent, limits_m)
    found = [f"by {UNITS[name]:g} if they are in {name}" for name in names]
    middle = (limits_m[0] * limits_m[1]) ** 0.5 / max(extent, 1e-12)
    mend = "scale the COLMAP model and the scan to metres, " + " or ".join(found)
    if not found:
        mend = (
            f"scale the COLMAP model and the scan by about {middle:.3g}: no unit has this factor, the world seems to "
            "have no scale; measure a length to know it"
        )
    fix = None
    if len(names) == 1:
        fix = scaled_world(UNITS[names[0]], f"scaled the cameras from {names[0]} to metres")
    return Finding(
        kind="unit",
        severity="error",
        where=str(capture.root / "sparse"),
        believed=believed,
        expected=expected,
        evidence=evidence,
        mend=mend,
        fix=fix,
    ).error
