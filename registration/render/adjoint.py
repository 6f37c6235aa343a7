"""The adjoint image, and deterministic sums of the lanes' contributions to vertices and texels."""

from __future__ import annotations  # mi.Float exists only after a variant is set

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
from torch import Tensor

from registration.render.shading import GROUPS, MASK, RenderMesh

_MAX_SAMPLES = 1 << 12  # values of a tensor from which its magnitude is estimated
_UNIT = 2.0**-22  # of fixed-point sums, relative to the largest sampled adjoint (per metre)
_MAX_UNITS = 2.0**42  # of one lane: the sum of a million such lanes fits into 64 bits


@dataclass(frozen=True, kw_only=True)
class Adjoint:
    """dLoss / d(channel) of every pixel by groups of channels; None where the loss does not depend on a group."""

    groups: list[mi.Float | None]  # in the order of GROUPS, each (P D) flat
    widths: list[int]
    unit: mi.Float  # of `RowSum`

    @classmethod
    def from_gradients(cls, gradients: Sequence[Tensor | None], mesh: RenderMesh) -> Adjoint:
        """Convert torch's gradients; without a texture the colour is ignored."""
        values = [None if g is None else g.detach().contiguous().reshape(-1) for g in gradients]
        if mesh.texture is None:
            values[0] = None
        return cls(
            groups=[None if g is None else mi.Float(g) for g in values],
            widths=[3, 3, 1, mesh.class_count],
            unit=unit_of([g for g in values if g is not None]),
        )

    @property
    def has_interior(self) -> bool:
        """Whether the loss depends on a channel that varies inside a face, unlike the mask."""
        return any(g is not None and group.start != MASK for g, group in zip(self.groups, GROUPS, strict=True))

    def colour(self, pixel: mi.UInt32) -> mi.Vector3f | None:
        """Return the adjoint of the colour of the lanes' pixels."""
        return None if self.groups[0] is None else dr.gather(mi.Vector3f, self.groups[0], pixel)

    def normal(self, pixel: mi.UInt32) -> mi.Vector3f | None:
        """Return the adjoint of the normal of the lanes' pixels."""
        return None if self.groups[1] is None else dr.gather(mi.Vector3f, self.groups[1], pixel)

    def classes(self, pixel: mi.UInt32) -> mi.ArrayXf | None:
        """Return the adjoint of the classes of the lanes' pixels."""
        return None if self.groups[3] is None else self._group(3, pixel)

    def _group(self, number: int, pixel: mi.UInt32) -> mi.ArrayXf:
        shape = (self.widths[number], dr.width(pixel))
        return dr.gather(mi.ArrayXf, self.groups[number], pixel, shape=shape)

    def dot(self, channels: Sequence[mi.Float], pixel: mi.UInt32) -> mi.Float:
        """Return the sum of adjoint times value over the channels, in the lanes' pixels."""
        total = mi.Float(0)
        for number, group in enumerate(GROUPS):
            if self.groups[number] is not None:
                for g, value in zip(self._group(number, pixel), channels[group], strict=True):
                    total += g * value
        return total


def unit_of(values: Sequence[Tensor]) -> mi.Float:
    """Return a unit of `RowSum` that suits values of this magnitude."""
    scale = max((_magnitude(v[:: 1 + len(v) // _MAX_SAMPLES]) for v in values), default=0.0)
    if scale == 0:
        scale = max((_magnitude(v) for v in values), default=0.0)
    return dr.opaque(mi.Float, max(scale, 1e-30) * _UNIT)


def _magnitude(values: Tensor) -> float:
    return values.abs().max().item() if values.numel() else 0.0


class RowSum:
    """Sums of the lanes' vectors in the rows of a table.

    With a unit the sums are in fixed point, because parallel sums of floats differ from run to run.
    """

    def __init__(self, rows: int, unit: mi.Float | None = None, columns: int = 4):
        """
        Args:
            rows: of the table.
            unit: of fixed-point sums, see `unit_of`; None: floating point.
            columns: of the table, four or eight.
        """
        self._unit, self._columns = unit, columns
        number = mi.Float if unit is None else mi.Int64
        self._packet = mi.ArrayXf if unit is None else dr.int64_array_t(mi.ArrayXf)
        self.total = dr.zeros(number, columns * rows)
        # On the CPU every thread has its own partial sums.
        self._mode = dr.ReduceMode.Expand if "llvm" in mi.variant() else dr.ReduceMode.Auto

    def add(self, row: mi.UInt32, value: Iterable[mi.Float]) -> None:
        """Add up to `columns` values per lane; three or four values are added to the first columns."""
        values = list(value)
        if self._unit is not None:
            per_unit = dr.rcp(self._unit)
            values = [mi.Int64(dr.clip(v * per_unit, -_MAX_UNITS, _MAX_UNITS)) for v in values]
        packet = 4 if len(values) <= 4 else 8
        values += [type(values[0])(0)] * (packet - len(values))
        dr.scatter_add(self.total, self._packet(values), row * (self._columns // packet), mode=self._mode)

    def table(self) -> mi.Float:
        """Return the table, flat, row by row."""
        return self.total if self._unit is None else mi.Float(mi.Float64(self.total) * mi.Float64(self._unit))
