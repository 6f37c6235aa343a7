"""`gnmreg stereo`: depths, normals and a cloud from the photographs of a capture."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from workflows.cli.options import NOT_SET, CaptureFolder, Folder

if TYPE_CHECKING:
    from registration.stereo.of_capture import Surface
    from registration.types import Capture

OptionalSurface = Annotated[Path | None, arg(metavar="REG|MESH", help_behavior_hint=NOT_SET)]


def stereo(
    capture: CaptureFolder,
    /,
    out: Folder,
    surface: OptionalSurface = None,
    backend: Literal["sgbm", "colmap"] = "sgbm",
) -> int:
    """Compute depths, normals and a cloud of points from the photographs of a capture.

    Writes normals/, depth/ and confidence/ (as in a capture), scan.ply (points with normals) and stereo.png (a sheet of
    the maps). The head is found by the capture's landmarks or masks, else by detected landmarks.

    Args:
        capture: The capture folder; it is not changed.
        out: The folder to write; it must not exist.
        surface: A registration's folder or a mesh within 4 mm of the head, in the capture's world, around which is
            searched: finer, and what is hidden is known. Without it the first pass's own depths are refined.
        backend: sgbm: ours, on any computer. colmap: COLMAP's PatchMatch on an NVIDIA GPU (extra colmap-cuda).
    """
    from registration.capture.native import read_capture
    from registration.progress import console_progress
    from registration.stereo import of_capture
    from registration.stereo.head_position import find_head

    of_capture.check_out(out)
    read = read_capture(capture)
    mesh = None if surface is None else _surface(surface)
    with console_progress() as progress:
        head = find_head(_with_head(read))
        views = of_capture.read_photographs(read, head)
        found = of_capture.capture_depths(
            read, views, head, mesh, backend, lambda done: progress.update(round(100 * done), 100, "stereo")
        )
    of_capture.write_depths(found, read, views, out)
    points = len(found.cloud.points)
    print(f"depths cover {found.coverage:.0%} of the head (median over the views); {points} points in the cloud")
    for warning in found.warnings:
        print(f"warning: {warning}; see {out / 'stereo.png'}")
    print(out)
    return 0


def _with_head(capture: "Capture") -> "Capture":
    """The capture, with detected landmarks if it has neither landmarks nor masks."""
    if any(view.landmarks or view.mask for view in capture.views):
        return capture
    from registration.detect.detection import detect_landmarks
    from registration.detect.providers import load_provider

    detected = detect_landmarks(capture, load_provider("face478"))
    if not detected.usable:
        raise detected.error(capture)
    return detected.into(capture)


def _surface(path: Path) -> "Surface":
    if path.is_dir():
        from registration.storage.registration_folder import load_registration

        registered = load_registration(path)
        return registered.vertices, registered.triangles
    from registration.capture.scan import read_scan
    from registration.errors import InputError

    scan = read_scan(path)
    if not len(scan.triangles):
        raise InputError(
            "The surface has no faces",
            where=path,
            expected="a triangle mesh",
            got=f"a cloud of {len(scan.vertices)} points",
            fix="give a mesh or a registration's folder",
        )
    return scan.vertices, scan.triangles
