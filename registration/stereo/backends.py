"""Programs that compute depths from photographs: ours, and COLMAP's on an NVIDIA GPU."""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.stereo.depth_map import DepthMap
from registration.stereo.views import StereoView

BACKENDS = ("sgbm", "colmap")


@runtime_checkable
class StereoBackend(Protocol):
    """Depths of a head from photographs."""

    def depths(
        self,
        views: Sequence[StereoView],
        centre: Float[np.ndarray, "3"],
        radius_m: float,
        progress: Callable[[float], None] | None = None,
    ) -> tuple[DepthMap | None, ...]:
        """Return one map per view, None where it does not show the head.

        Args:
            views: photographs without distortion.
            centre: of the head, world, metres.
            radius_m: of a sphere around the head.
            progress: called with the fraction done.

        Raises:
            InputError: no views overlap, or the backend cannot run here.
        """


def load_backend(name: str) -> StereoBackend:
    """Return a backend by its name, one of `BACKENDS`. Raises InputError for another one."""
    if name == "sgbm":
        return _Sgbm()
    if name == "colmap":
        from registration.stereo.patch_match import PatchMatch

        return PatchMatch()
    raise InputError(
        "There is no such stereo backend",
        where="backend",
        expected=" or ".join(BACKENDS),
        got=name,
        fix="name one of these",
    )


class _Sgbm:
    def depths(
        self,
        views: Sequence[StereoView],
        centre: Float[np.ndarray, "3"],
        radius_m: float,
        progress: Callable[[float], None] | None = None,
    ) -> tuple[DepthMap | None, ...]:
        from registration.stereo.first_pass import first_depths

        return first_depths(views, centre, radius_m, progress=progress)
