"""Names of what evaluations measure, for tables and pages: importing them loads no numeric library."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Level = Literal["good", "look", "wrong"]
LEVEL_TITLES: Mapping[Level, str] = {"good": "good", "look": "look at it", "wrong": "wrong"}
TOLERANCE_MM = 0.3
SHARP_FOLD_DEG = 120.0  # turn of the surface at an edge, beyond which it is a fold
REVERSED_SKIN_MM2 = 2.0  # of skin that is turned inside out: good registrations have up to 1, rolled lids 3 to 20
BEYOND_KEY = f"vertices_beyond_{TOLERANCE_MM}mm"  # of a penetration audit's figures


@dataclass(frozen=True, kw_only=True)
class ResidualKind:
    """One kind of residual, as the report and the terminal show it."""

    title: str
    unit: str
    meaning: str

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        space = "" if self.unit == "°" else "\N{NO-BREAK SPACE}"
        return f"{value:.{2 if self.unit == 'mm' else 1}f}{space}{self.unit}"


RESIDUALS: Mapping[str, ResidualKind] = {
    "silhouette_px": ResidualKind(
        title="silhouette", unit="px", meaning="mean distance of the outlines; the head is 512 px high"
    ),
    "normals_deg": ResidualKind(title="normals", unit="°", meaning="median angle between the normals"),
    "depth_mm": ResidualKind(title="depth", unit="mm", meaning="median distance of the depth maps from the skin"),
    "colour_levels": ResidualKind(
        title="colour", unit="levels", meaning="mean difference of the colours, of 255 sRGB levels"
    ),
    "labels_percent": ResidualKind(title="labels", unit="%", meaning="pixels whose label is another one"),
    "landmarks_px": ResidualKind(
        title="landmarks", unit="px", meaning="median distance of the landmarks; the head is 512 px high"
    ),
}
