"""The way back from pixels to vertices: the adjoint image, and sums over lanes that do not depend on their order."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import torch
from torch import Tensor

from registration.render.shading import GROUPS, MASK, Surface

_SAMPLED = 61  # every so-many-th value tells how large adjoints are
_UNIT = 2.0**-22  # of a sum, in the largest adjoint sampled (per metre): integers below count such units
_MOST = 2.0**42  # units of one lane: a million such lanes still fit


@dataclass(frozen=True, kw_only=True)
class Adjoint:
    """dLoss / d(channel) of every pixel, by groups of channels; None where the loss does not look."""

    groups: list[mi.Float | None]  # in the order of GROUPS, each (P D) flat
    widths: list[int]
    unit: mi.Float  # see `VertexSum`

    @classmethod
    def of(cls, gradients: Sequence[Tensor | None], surface: Surface) -> Adjoint:
        """From what torch hands back; without a texture the colour is left out."""
        known = [None if g is None else g.detach().contiguous().reshape(-1) for g in gradients]
        if surface.texture is None:
            known[0] = None
        largest = [g[::_SAMPLED].abs().max() for g in known if g is not None and len(g)]
        device = next((g.device for g in known if g is not None), torch.device("cpu"))
        scale = torch.stack(largest).max() if largest else torch.zeros((), device=device)
        return cls(
            groups=[None if g is None else mi.Float(g) for g in known],
            widths=[3, 3, 1, surface.class_count],
            unit=mi.Float((scale.clamp(min=1e-30) * _UNIT).reshape(1).contiguous()),
        )

    @property
    def moves_inside(self) -> bool:
        """Whether the loss looks at anything that varies inside a face: the mask does not."""
        return any(g is not None and group.start != MASK for g, group in zip(self.groups, GROUPS, strict=True))

    def times(
        self,
        channels: Sequence[mi.Float],
        pixel: mi.UInt32,
        active: mi.Bool | bool = True,
        without: int | None = None,
    ) -> mi.Float:
        """Sum over the channels (but one) of adjoint times value, in the lanes' pixels; 0 where not active."""
        total = mi.Float(0)
        for values, width, group in zip(self.groups, self.widths, GROUPS, strict=True):
            if values is None or group.start == without:
                continue
            g = dr.gather(mi.ArrayXf, values, pixel, active, shape=(width, dr.width(pixel)))
            for k in range(width):
                total += g[k] * channels[group.start + k]
        return total


class VertexSum:
    """Sums of lanes' vectors at vertices, in fixed point: parallel sums of floats would differ from run to run."""

    def __init__(self, vertex_count: int, adjoint: Adjoint):
        self._unit = adjoint.unit
        self.total = dr.zeros(mi.Int64, 3 * vertex_count)

    def add(self, vertex: mi.UInt32, value: mi.Vector3f) -> None:
        for k in range(3):
            units = dr.clip(value[k] / self._unit, -_MOST, _MOST)
            dr.scatter_add(self.total, mi.Int64(dr.detach(units)), vertex * 3 + k)

    def tensor(self) -> Tensor:
        """(V, 3), a copy."""
        total = mi.Float(mi.Float64(self.total) * mi.Float64(self._unit))
        dr.eval(total)
        dr.sync_thread()
        return total.torch().view(-1, 3).clone()
