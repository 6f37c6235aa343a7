"""Frames in which a mesh may have been exported: units, and exchanges of axes."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float

# Unit -> metres.
UNITS = {
    "millimetres": 1e-3,
    "centimetres": 1e-2,
    "inches": 0.0254,
    "decimetres": 0.1,
    "feet": 0.3048,
    "kilometres": 1e3,
}
_AXES = "xyz"


@dataclass(frozen=True, kw_only=True)
class Frame:
    """How a file's coordinates may have been exported: world axis k is sign * file axis, times the unit."""

    unit: float  # metres per unit of the file
    axes: tuple[int, int, int]
    signs: tuple[int, int, int]

    @property
    def plain(self) -> bool:
        return self.axes == (0, 1, 2) and self.signs == (1, 1, 1)

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(np.eye(3)[list(self.axes)] * self.signs) < 0)

    def to_file(self, world: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """World points (m) in the coordinates that the file would give them."""
        points = np.empty_like(world)
        points[:, list(self.axes)] = world * self.signs / self.unit
        return points

    def to_world(self, file: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Points of the file in the world, metres."""
        return file[:, list(self.axes)] * self.signs * self.unit

    def __str__(self) -> str:
        turned = ", ".join(("-" if s < 0 else "") + _AXES[k] for k, s in zip(self.axes, self.signs, strict=True))
        parts = [f"in {_UNIT_NAMES[self.unit]}"] if self.unit != 1 else []
        parts += [] if self.plain else [f"{'mirrored' if self.mirrored else 'turned'}: the world is its ({turned})"]
        return " and ".join(parts)


_UNIT_NAMES = {1.0: "", **{unit: name for name, unit in UNITS.items()}}


def candidate_frames() -> Iterator[Frame]:
    """All units and all axes, simpler ones first."""
    axes = [(a, s) for a in permutations(range(3)) for s in product((1, -1), repeat=3)]
    turned = [Frame(unit=1.0, axes=a, signs=s) for a, s in axes]  # type: ignore[arg-type]
    turned.sort(key=lambda frame: (not frame.plain, frame.mirrored))
    for frame in turned:
        for unit in _UNIT_NAMES:
            yield Frame(unit=unit, axes=frame.axes, signs=frame.signs)
