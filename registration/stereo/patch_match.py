"""Depths by COLMAP's PatchMatch stereo (Schoenberger et al. 2016), which needs an NVIDIA GPU.

The package `pycolmap-cuda12` contains GPL code and is installed by whoever wants it; this module alone imports it.
"""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from registration.capture.colmap import write_model
from registration.capture.dense_maps import read_colmap_map
from registration.errors import InputError
from registration.stereo.agreement import Measured
from registration.stereo.depth_map import DepthMap
from registration.stereo.pairs import choose_partners
from registration.stereo.second_pass import SecondPassOptions, joined_maps
from registration.stereo.views import HeadImage, StereoView, head_image

_PARTNERS = 6  # of each view
_SIGMA_PX = 0.3  # standard deviation of a match, for the comparison of depths of several views


class PatchMatch:
    """COLMAP's dense stereo on the windows around the head."""

    def depths(
        self,
        views: Sequence[StereoView],
        centre: Float[np.ndarray, "3"],
        radius_m: float,
        progress: Callable[[float], None] | None = None,
    ) -> tuple[DepthMap | None, ...]:
        """Return maps as `backends.StereoBackend.depths`; confidence is by the agreement of views."""
        colmap = _colmap()
        windows = [head_image(view, centre, radius_m) for view in views]
        images = [window for window in windows if window is not None]
        partners = choose_partners([image.camera for image in images], centre, _PARTNERS)
        with tempfile.TemporaryDirectory() as folder:
            workspace = Path(folder)
            write_workspace(workspace, images, partners)
            distances = [float(np.linalg.norm(image.camera.centre - centre)) for image in images]
            options = colmap.PatchMatchOptions()
            options.depth_min, options.depth_max = min(distances) - radius_m, max(distances) + radius_m
            options.geom_consistency = True
            colmap.patch_match_stereo(workspace, options=options)
            measured = [_read(workspace, k, image, centre) for k, image in enumerate(images)]
        found = iter(joined_maps(partners, measured, SecondPassOptions()))
        if progress is not None:
            progress(1.0)
        return tuple(None if window is None else next(found) for window in windows)


def write_workspace(workspace: Path, images: Sequence[HeadImage], partners: Sequence[Sequence[int]]) -> None:
    """Write what COLMAP's dense stereo reads: images, a sparse model without points, and the partners of each view.

    Args:
        workspace: an existing folder.
        images: of the views, which are named 0000.png and so on.
        partners: of each view.
    """
    (workspace / "images").mkdir()
    for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
        (workspace / "stereo" / kind).mkdir(parents=True)
    for k, image in enumerate(images):
        grey = np.clip(np.round(image.grey), 0, 255).astype(np.uint8)
        if not cv2.imwrite(str(workspace / "images" / _name(k)), grey):
            raise OSError(f"{workspace}: an image cannot be written")
    write_model(workspace / "sparse", {_name(k): one.camera for k, one in enumerate(images)}, np.zeros((0, 3)))
    lines = [(_name(k), ", ".join(map(_name, near))) for k, near in enumerate(partners) if near]
    (workspace / "stereo" / "patch-match.cfg").write_text("".join(f"{a}\n{b}\n" for a, b in lines), "utf-8")


def _name(view: int) -> str:
    return f"{view:04d}.png"


def _read(workspace: Path, view: int, image: HeadImage, centre: Float[np.ndarray, "3"]) -> Measured:
    path = workspace / "stereo" / "depth_maps" / f"{_name(view)}.geometric.bin"
    depth = np.zeros(image.grey.shape, np.float32)
    if path.is_file():  # a view without partners has none
        depth = np.where(image.mask, read_colmap_map(path, "depth map", image.camera, 1)[..., 0], 0).astype(np.float32)
    pixel = float(np.linalg.norm(image.camera.centre - centre) / image.camera.intrinsics[0, 0])
    sigma = np.full(depth.shape, _SIGMA_PX * pixel, np.float32)
    return Measured(camera=image.camera, depth=depth, sigma=sigma)


def _colmap() -> Any:
    colmap: Any = None
    try:
        import pycolmap as colmap
    except ImportError:
        pass
    if colmap is None or not colmap.has_cuda:
        raise InputError(
            "COLMAP's stereo cannot run here",
            where="backend colmap",
            expected="the package pycolmap-cuda12 and an NVIDIA GPU",
            got="no pycolmap" if colmap is None else "a pycolmap without CUDA",
            fix="install the extra colmap-cuda on a machine with a GPU, or use the backend sgbm",
        )
    return colmap
