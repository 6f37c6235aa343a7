"""Make a native capture from a scan alone: virtual cameras around the head render the scan."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from registration.capture.native_writer import CaptureDescription, ViewArrays, check_new, write_capture
from registration.capture.scan import Scan, read_scan_file
from registration.capture.settings import read_settings
from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.closest_point import ClosestPointQuery
from registration.geometry.rasterizer import RayCaster
from registration.geometry.surface_views import SurfaceViews
from registration.model.gnm_npz import GNMData, content_hash
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import exterior, eyeballs
from registration.progress import NullProgress, Progress
from registration.scan_capture.hygiene import RawScan, clean, hygiene_notes
from registration.scan_capture.picked_points import PickedPoints, read_picked_points
from registration.scan_capture.pictures import Colours, camera_normals
from registration.scan_capture.placement import UNITS_M, Placed, Search
from registration.scan_capture.rig import head_cameras
from registration.storage.hashing import hash_arrays, hash_file, input_hash
from registration.storage.mesh_files import MeshFile
from registration.types import Camera, HeadPose

_SKIN_M = 8e-3  # from the placed model: what is farther is hair, clothes or another thing, and gives no normals
_VISIBLE_M = 3e-3  # by which the scan may hide a landmark: picked points lie a little inside
_UNSEEN = 0.2  # confidence of a landmark that a view does not show
_LEAST_VIEW = 0.15  # of the best view's trusted pixels: views that show less are left out
_POINTS = 2000  # of the scan in the COLMAP model


@dataclass(frozen=True, kw_only=True)
class ScanCapture:
    """A capture that was made from a scan."""

    root: Path
    figures: Mapping[str, Any]  # `scan_hygiene` of docs/formats.md
    notes: tuple[str, ...]  # for the user


@dataclass(frozen=True, kw_only=True)
class ScanSource:
    """The files that a capture is made from."""

    file: Path  # a mesh: PLY, OBJ, GLB or glTF
    landmarks: Path | None = None  # points on the scan, in its unit and axes
    scheme: str | None = None  # of the landmarks; None: as the file says, else 68
    unit: str | None = None  # of the scan, a key of `UNITS_M`; None: by the head's size


def make_capture(
    source: ScanSource,
    root: Path,
    data: GNMData,
    schemes: Mapping[str, LandmarkScheme],
    progress: Progress | None = None,
) -> ScanCapture:
    """Read, clean and place a scan, and write a native capture folder with renderings of it.

    The capture's world has the scan's axes and origin, in metres.

    Args:
        source: the scan and its landmarks.
        root: the capture's folder. One that was made from the same files is kept, one from others replaced.
        data: the model that is going to be fitted.
        schemes: of the model.
        progress: where to report to.

    Returns:
        The capture, and what was found and left out.

    Raises:
        InputError: the scan or the landmarks cannot be used, or the folder holds something else.
    """
    progress = progress or NullProgress()
    file, unit = source.file, source.unit
    if unit is not None and unit not in UNITS_M:
        raise InputError("The unit is not known", where="--unit", expected=", ".join(UNITS_M), got=unit)
    progress.message(f"reading {file}")
    mesh = read_scan_file(file)
    raw, hygiene = clean(mesh, file)
    picked = _picked(source, schemes)
    digest = _digest(mesh, picked, source, data)
    if (same := _existing(root, digest)) is not None:
        return same
    progress.message("finding the head in the scan")
    search = Search(raw, data, file)
    if picked is None:
        placed = search.without_landmarks(unit)
    else:
        placed = search.from_landmarks(picked.points, schemes[picked.scheme], data, unit)
    scan = raw.scaled(UNITS_M[placed.unit])
    scan = scan.turned_over() if placed.inside_out else scan
    counted = _counted(scan, placed, data)
    cameras = _cameras(placed, data)
    progress.message("rendering the scan")
    points = None if picked is None else {picked.scheme: picked.points * UNITS_M[placed.unit]}
    views = _views(scan, counted, cameras, points or {})
    figures = _figures(scan, placed, hygiene, counted, mesh)
    notes = _notes(figures, placed, mesh, scan)
    description = CaptureDescription(
        subject=file.stem,
        expression="scan",
        tags={"scan_hygiene": figures, "scan_notes": list(notes), "made_from": digest},
        photographs=scan.coloured,
        head=_head_pose(placed) if points is None else None,
    )
    vertices = scan.vertices[:: -(-len(scan.vertices) // _POINTS)]
    if root.exists():  # made from other files
        shutil.rmtree(root)
    whole = Scan(vertices=scan.vertices, triangles=scan.triangles)
    write_capture(root, views, description, points=vertices, scan=whole)
    return ScanCapture(root=root, figures=figures, notes=notes)


def _picked(source: ScanSource, schemes: Mapping[str, LandmarkScheme]) -> PickedPoints | None:
    if source.landmarks is None:
        return None
    lengths = {name: len(one.indices) for name, one in schemes.items()}
    return read_picked_points(source.landmarks, source.scheme, lengths)


def _digest(mesh: MeshFile, picked: PickedPoints | None, source: ScanSource, data: GNMData) -> str:
    """One digest of all that decides the capture."""
    arrays = [value for value in (mesh.vertices, mesh.triangles, mesh.colours, mesh.corner_uvs) if value is not None]
    arrays += [texture for texture in mesh.textures if isinstance(texture, np.ndarray)]
    arrays += [] if picked is None else [picked.points]
    files = {str(k): hash_file(file) for k, file in enumerate(mesh.textures) if isinstance(file, Path)}
    files |= {"arrays": hash_arrays(*arrays), "model": content_hash(data)}
    return input_hash(files, {"unit": source.unit, "scheme": None if picked is None else picked.scheme})


def _existing(root: Path, digest: str) -> ScanCapture | None:
    """The capture that was made from the same input; None if there is none, or one from another scan.

    Raises:
        InputError: there is something else.
    """
    if not root.exists():
        return None
    tags = read_settings(root / "capture.toml").tags if (root / "capture.toml").is_file() else {}
    if "made_from" not in tags:
        check_new(root)
    if tags.get("made_from") != digest:
        return None
    return ScanCapture(root=root, figures=tags.get("scan_hygiene", {}), notes=tuple(tags.get("scan_notes", ())))


def _counted(scan: RawScan, placed: Placed, data: GNMData) -> Bool[np.ndarray, "F"]:
    """The faces of the scan that may be skin: close to the model as it was placed."""
    outside = np.any([exterior(data), *eyeballs(data)], axis=0)
    triangles = data.triangles[outside[data.triangles].all(1)]
    surface = placed.placement.mesh(placed.sample, data)
    distance = ClosestPointQuery(surface, triangles).closest(scan.vertices)[0]
    return np.asarray((distance[scan.triangles] < _SKIN_M * placed.placement.scale).all(1))


def _cameras(placed: Placed, data: GNMData) -> dict[str, Camera]:
    head = exterior(data)
    template = data.template_vertex_positions[head].astype(np.float64)
    face = placed.sample.template[placed.sample.face]
    crown, chin = template[:, 1].max(), face[:, 1].min()
    centre = np.array([0.0, (crown + chin) / 2, (template[:, 2].max() + template[:, 2].min()) / 2])
    placement = placed.placement
    return head_cameras(
        placement.scale * placement.rotation @ centre + placement.shift, placement.rotation, placement.scale
    )


def _views(
    scan: RawScan,
    counted: Bool[np.ndarray, "F"],
    cameras: Mapping[str, Camera],
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]],
) -> list[ViewArrays]:
    """Render the views that show enough of what counts."""
    surface = SurfaceViews(scan.vertices, scan.triangles, list(cameras.values()))
    caster, colours = RayCaster(scan.vertices, scan.triangles), Colours(scan)
    views, shown = [], []
    for name, camera in cameras.items():
        view = surface.view(camera)
        normals = camera_normals(view, camera, counted)
        shown.append(int(normals.any(-1).sum()))
        rgb = np.round(colours.of(view, camera) * 255).astype(np.uint8)
        projected = {scheme: _projected(points, camera, caster) for scheme, points in landmarks.items()}
        views.append(ViewArrays(name=name, camera=camera, rgb=rgb, normals=normals, landmarks=projected))
    return [view for view, count in zip(views, shown, strict=True) if count >= _LEAST_VIEW * max(shown)]


def _projected(points: Float[np.ndarray, "L 3"], camera: Camera, caster: RayCaster) -> Float[np.ndarray, "L 3"]:
    """x, y and confidence of landmarks in a view."""
    given = np.isfinite(points).all(1)
    rows = np.zeros((len(points), 3))
    rows[given, :2] = camera.project(points[given])[0]
    rows[given, 2] = np.where(caster.visible(points[given], camera, _VISIBLE_M), 1.0, _UNSEEN)
    return rows


def _head_pose(placed: Placed) -> HeadPose:
    placement = placed.placement
    return HeadPose(rotation=placement.rotation, translation=placement.shift, scale=placement.scale)


def _figures(
    scan: RawScan, placed: Placed, hygiene: Mapping[str, Any], counted: Bool[np.ndarray, "F"], mesh: MeshFile
) -> dict[str, Any]:
    a, b, c = (scan.vertices[scan.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return {
        **placed.figures,
        **hygiene,
        "extent_mm": [round(float(side) * MM_PER_M, 1) for side in np.ptp(scan.vertices, axis=0)],
        "inside_out": placed.inside_out,
        "colours": "texture" if scan.textures else "vertices" if scan.colours is not None else "none",
        "counted_area": round(float(area[counted].sum() / area.sum()), 3),
    }


def _notes(figures: Mapping[str, Any], placed: Placed, mesh: MeshFile, scan: RawScan) -> tuple[str, ...]:
    extent = " x ".join(f"{side:.0f}" for side in figures["extent_mm"])
    lines = [
        f"scan: {len(scan.vertices)} vertices, {len(scan.triangles)} faces, taken as {placed.unit}: {extent} mm",
        *hygiene_notes(figures),
        *(f"scan: {note}" for note in mesh.notes),
        f"head placed by {figures['placed_by']}: {figures['face_on_scan']:.0%} of the model's face lies on the scan",
        *placed.notes,
        f"{figures['counted_area']:.0%} of the scan's area gives normals; the rest is more than "
        f"{_SKIN_M * MM_PER_M:.0f} mm from any face of the model: hair, clothes and the like",
    ]
    lines += ["the scan's faces point inwards: it is inside out, and is turned over"] if placed.inside_out else []
    lines += [] if scan.coloured else ["the scan has no colours: its pictures have no weight"]
    return tuple(lines)
