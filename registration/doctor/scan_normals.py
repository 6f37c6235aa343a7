"""What a scan's normals give the views that have no normal maps: a row of the ledger."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.capture.samples import ViewSample
from registration.capture.scan import Scan
from registration.capture.visual_hull import outside_masks
from registration.doctor.ledger import Channel
from registration.geometry.surface_views import SurfaceViews
from registration.types import Camera, Capture

_FEW = 0.2  # of the subject's pixels


def scan_normals(capture: Capture, samples: Sequence[ViewSample], scan: Scan) -> tuple[Channel | None, list[str]]:
    """Count the pixels for which a scan's normals stand in for normal maps.

    Args:
        capture: whose views may lack normal maps.
        samples: of its views.
        scan: of the capture.

    Returns:
        The ledger's row, None if the scan gives no normals; and warnings.
    """
    without = {view.name: view.camera for view in capture.views if not view.has_normals}
    if not without:
        return None, []
    if not len(scan.triangles):
        cloud = "the scan is a point cloud, whose normals are not known; export it as a mesh"
        return None, [f"{len(without)} of {len(capture.views)} views have no normals: {cloud}"]
    foreign = outside_masks(capture, scan.vertices)
    cameras = [view.camera for view in capture.views]
    surface = SurfaceViews(scan.vertices, scan.triangles, cameras, foreign=foreign)
    total, losses = 0, Counter[str]()
    for sample in samples:
        if (camera := without.get(sample.name)) is not None:
            total += int(sample.subject.sum())
            losses += _losses(sample, surface, foreign[scan.triangles].any(1), camera)
    counted = total - losses.total()
    row = Channel(
        name="scan normals",
        files=1,
        matched=len(without),
        unit="sampled pixels",
        total=total,
        counted=counted,
        losses=dict(losses.most_common()),
    )
    if counted < _FEW * total:
        return row, [
            f"the scan's normals stand in for normal maps on {counted / total:.0%} of the subject's pixels only"
        ]
    return row, []


def _losses(sample: ViewSample, surface: SurfaceViews, foreign: Bool[np.ndarray, "F"], camera: Camera) -> Counter[str]:
    """Reason -> how many of the subject's pixels it costs; `foreign` faces lie outside the masks."""
    height, width = sample.subject.shape
    small = replace(camera.scaled(width, height), distortion=())
    view = surface.view(small)
    row, column = _pixels(sample.rays, small)
    weight, hit = view.weight[row, column] > 0, view.face[row, column] >= 0
    outside = hit & foreign[view.face[row, column]]
    reasons = {"no surface": ~hit, "outside other masks": outside, "at an edge or grazing": hit & ~outside & ~weight}
    return Counter({reason: int((sample.subject & lost).sum()) for reason, lost in reasons.items()})


def _pixels(rays: Float[np.ndarray, "h w 3"], camera: Camera) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """Rows and columns where an undistorted camera shows what rays of the distorted one see, clipped to its image."""
    xy = rays @ camera.intrinsics.T
    column, row = np.floor(xy[..., :2] / xy[..., 2:]).astype(np.int64).transpose(2, 0, 1)
    return row.clip(0, camera.height_px - 1), column.clip(0, camera.width_px - 1)
