"""Native capture folders as a source: to scale one, or to undistort lenses that a registration does not read."""

from pathlib import Path

import numpy as np

from registration.capture.colmap import read_images
from registration.capture.native import read_capture
from registration.formats.colmap_lenses import lens_of
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView
from registration.types import Camera, View


def _detect(path: Path) -> bool:
    return (path / "capture.toml").is_file()


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read a native capture folder; cameras may have any of COLMAP's lenses.

    Raises:
        InputError: as `registration.capture.native.read_capture`.
    """
    lenses: dict[str, Distortion] = {}

    def pinholes(sparse: Path) -> dict[str, Camera]:
        cameras = {}
        for name, image in read_images(sparse).items():
            intrinsics, lenses[name] = lens_of(image)
            width_px, height_px, T = image.camera.width_px, image.camera.height_px, image.T_cam_world
            cameras[name] = Camera(width_px=width_px, height_px=height_px, intrinsics=intrinsics, T_cam_world=T)
        return cameras

    capture = read_capture(path, cameras_of=pinholes)
    images = path / "images"
    notes = () if capture.ground_truth is None else ("ground_truth.npz was left out: it is for tests",)
    return SourceCapture(
        format=FORMAT.name,
        root=path,
        subject=options.subject or capture.subject,
        expression=options.expression or capture.expression,
        views=tuple(_view(view, lenses[view.image.relative_to(images).as_posix()]) for view in capture.views),
        unit_m=1.0,
        scan=capture.scan,
        classes=capture.classes,
        labels=capture.labels,
        tags=capture.tags,
        notes=notes,
    )


def _view(view: View, lens: Distortion) -> SourceView:
    camera = view.camera
    return SourceView(
        name=view.name,
        image=view.image,
        width_px=camera.width_px,
        height_px=camera.height_px,
        intrinsics=np.array(camera.intrinsics),
        T_cam_world=camera.T_cam_world,
        distortion=lens,
        colour=view.colour,
        mask=view.mask,
        normals=view.normals,
        normals_frame=view.normals_frame,
        depth=view.depth,
        depth_unit_m=view.depth_unit_m,
        confidence=view.confidence,
        segmentation=view.segmentation,
        landmarks=view.landmarks,
        landmark_spread_px=view.landmark_spread_px,
    )


FORMAT = Format(
    name="native",
    title="native capture folder",
    files="capture.toml and sparse/",
    detect=_detect,
    read=read,
    physical=True,
)
