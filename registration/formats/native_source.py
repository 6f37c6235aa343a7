"""Native capture folders as a source: to copy one, to scale it, or to look through a link into it."""

from pathlib import Path

from registration.capture.native import read_capture
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView
from registration.types import View


def _detect(path: Path) -> bool:
    return (path / "capture.toml").is_file()


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read a native capture folder. Raises InputError as `registration.capture.native.read_capture`."""
    capture = read_capture(path)
    notes = () if capture.ground_truth is None else ("ground_truth.npz was left out: it is for tests",)
    return SourceCapture(
        format=FORMAT.name,
        root=path,
        subject=options.subject or capture.subject,
        expression=options.expression or capture.expression,
        views=tuple(_view(view) for view in capture.views),
        unit_m=1.0,
        scan=capture.scan,
        classes=capture.classes,
        tags=capture.tags,
        notes=notes,
    )


def _view(view: View) -> SourceView:
    camera = view.camera
    return SourceView(
        name=view.name,
        image=view.image,
        width_px=camera.width_px,
        height_px=camera.height_px,
        intrinsics=camera.intrinsics,
        T_cam_world=camera.T_cam_world,
        distortion=Distortion(model="opencv", coefficients=camera.distortion),
        colour=view.colour,
        mask=view.mask,
        normals=view.normals,
        segmentation=view.segmentation,
        landmarks=view.landmarks,
    )


FORMAT = Format(
    name="native", title="native capture folder", files="capture.toml and sparse/", detect=_detect, read=read
)
