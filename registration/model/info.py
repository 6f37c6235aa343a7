"""Describe a model file: tables in the terminal and an image of the template."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.console import Console
from rich.table import Table
from rich.text import Text

from registration import terminal
from registration.frames import MM_PER_M
from registration.model import fetch, gnm_npz, gnmw, jaw_order, landmarks, regions
from registration.model.gnm_npz import GNMData
from registration.model.gnmw import WebModel
from registration.storage.files import check_output_file
from registration.storage.hashing import hash_file

COLOURS = {  # of the classes in images, linear
    "skin": (0.86, 0.70, 0.60),
    "left_eye": (0.35, 0.55, 0.95),
    "right_eye": (0.30, 0.75, 0.85),
    "upper_lip": (0.80, 0.25, 0.30),
    "lower_lip": (0.95, 0.45, 0.45),
    "ears": (0.95, 0.75, 0.30),
    "mouth_interior": (0.55, 0.35, 0.60),
}
_VIEWS = {"the subject's right": 75.0, "front": 0.0, "the subject's left": -75.0}  # rotation about +Y, degrees


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """A further panel of the picture: a part of the template, coloured, with lines and names on it."""

    title: str
    vertices: Bool[np.ndarray, "V"]  # of the part; triangles with all three are drawn
    colours: Float[np.ndarray, "V 3"]  # linear
    lines: Sequence[Float[np.ndarray, "P 3"]] = ()  # metres
    names: Mapping[str, Float[np.ndarray, "3"]] = field(default_factory=dict)  # text -> position, metres
    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))  # into a frame seen along -Z


Panels = Callable[[GNMData], tuple[Sequence[Panel], Sequence[str]]]


def describe(
    path: Path, picture: Path | None = None, console: Console | None = None, *, panels: Panels | None = None
) -> GNMData:
    """Print origin, digests, dimensions, parts, joints, regions and landmark schemes of a model file.

    Args:
        path: the model's NPZ file.
        picture: PNG file for an image of the template; None: none is drawn.
        console: to print to; None: the terminal.
        panels: gives further panels of the picture, and notes to print.

    Raises:
        InputError: the file is not a GNM model.
    """
    console = console or terminal.console()
    if picture is not None:
        check_output_file(Path(picture))
    data = gnm_npz.read(path)
    schemes = landmarks.schemes_beside(path, data.template_vertex_positions)
    title = f"  GNM {data.variant} {data.version}  sha256 {gnm_npz.content_hash(data)[:12]}"
    console.print(Text.assemble((str(path), "bold"), title))
    for table in (_file(Path(path), data), _dimensions(data), _parts(data), _joints(data), _regions(data)):
        console.print(table)
    console.print(f"landmark schemes: {', '.join(map(_scheme, schemes.values())) or 'none beside the file'}")
    shipped = landmarks.shipped_schemes(data)
    if others := [scheme for name, scheme in shipped.items() if name not in schemes]:
        console.print(f"shipped landmark maps of this topology: {', '.join(map(_scheme, others))}")
    for remark in data.remarks:
        console.print(Text(f"note: {remark}"))
    found, notes = panels(data) if panels is not None else ((), ())
    for note in notes:
        console.print(Text(note))
    if picture is not None:
        draw(data, picture, schemes, found)
        console.print(f"picture: {picture}")
    return data


def describe_web(path: Path, console: Console | None = None) -> WebModel:
    """Print the contents of a GNMW file. Raises InputError if it is none."""
    console = console or terminal.console()
    model = gnmw.read(path)
    console.print(Text.assemble((str(path), "bold"), f"  GNMW version {gnmw.VERSION}"))
    table = _table("contents", "name", "count", "field")
    for name, count, note in (
        ("vertices", len(model.vertices), ""),
        ("triangles", len(model.triangles), ""),
        ("identity", len(model.identity_scales), _step(model.identity_scales)),
        ("expression", len(model.expression_scales), _step(model.expression_scales)),
    ):
        table.add_row(name, f"{count:,}", note)
    table.add_row("bytes", f"{Path(path).stat().st_size:,}", Text(f"sha256 {hash_file(Path(path))}", overflow="fold"))
    console.print(table)
    if model.extra:
        console.print(Text(f"note: arrays that version {gnmw.VERSION} does not have: {', '.join(model.extra)}"))
    console.print("No joints, vertex groups, names or texture coordinates: for display, not for registration.")
    return model


def _step(scales: Float[np.ndarray, "K"]) -> str:
    return f"8 bits a value; the largest step is {MM_PER_M * scales.max():.4f} mm"


def draw(data: GNMData, path: Path, schemes: dict[str, landmarks.LandmarkScheme], panels: Sequence[Panel] = ()) -> None:
    """Draw the template from three sides, coloured by class, with the landmarks of every scheme, and further panels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    vertices = data.template_vertex_positions.astype(np.float64)
    names, membership = regions.vertex_classes(data)
    colours = membership @ np.array([COLOURS[name] for name in names])
    centre = (vertices.min(0) + vertices.max(0)) / 2
    half = 0.52 * np.ptp(vertices, axis=0).max()
    figure = Figure(figsize=(13, 9.4 if panels else 5.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2 if panels else 1, 12)
    for column, panel in enumerate(panels):
        width = 12 // len(panels)
        _draw_panel(figure.add_subplot(grid[1, width * column : width * (column + 1)]), panel, vertices, data.triangles)
    for column, (title, angle) in enumerate(_VIEWS.items()):
        axes = figure.add_subplot(grid[0, 4 * column : 4 * column + 4])
        rotation = rotation_y(angle)
        rotated = (vertices - centre) @ rotation.T
        polygons, shades = shaded(rotated, data.triangles, colours)
        axes.add_collection(PolyCollection(list(polygons), facecolors=shades, edgecolors=shades, linewidths=0.3))
        for scheme in schemes.values():
            points, outward = landmarks_in_view(scheme, rotated, data.triangles)
            x, y = points[outward].T[:2]
            axes.scatter(x, y, s=5, color="black", linewidths=0)
        axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", title=title)
        axes.set_axis_off()
    patches = [Patch(color=COLOURS[name], label=name) for name in names]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(names), frameon=False)
    size_mm = np.ptp(vertices, axis=0) * MM_PER_M
    figure.suptitle(f"GNM {data.variant} {data.version}: {size_mm[0]:.0f} x {size_mm[1]:.0f} x {size_mm[2]:.0f} mm")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_panel(axes: Any, panel: Panel, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> None:
    from matplotlib.collections import PolyCollection

    turned = vertices @ panel.rotation.T
    polygons, shades = shaded(turned, triangles[panel.vertices[triangles].all(1)], panel.colours)
    axes.add_collection(PolyCollection(list(polygons), facecolors=shades, edgecolors=shades, linewidths=0.3))
    for line in panel.lines:
        axes.plot(*(line @ panel.rotation.T)[:, :2].T, color="black", linewidth=1.2)
    for text, position in panel.names.items():
        axes.text(*(panel.rotation @ position)[:2], text, fontsize=7, ha="center", va="center")
    axes.set(aspect="equal", title=panel.title)
    axes.autoscale()
    axes.set_axis_off()


def rotation_y(degrees: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about +Y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def shaded(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], colours: Float[np.ndarray, "V 3"]
) -> tuple[Float[np.ndarray, "G 3 2"], Float[np.ndarray, "G 3"]]:
    """Return the triangles that face +Z, the most distant first, and their shaded colours."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-20
    front = np.flatnonzero(normals[:, 2] > 0)
    front = front[np.argsort(corners[front, :, 2].mean(1))]
    light = np.array([0.35, 0.5, 0.79])
    shade = 0.30 + 0.70 * np.clip(normals[front] @ light, 0, 1)
    return corners[front, :, :2], np.clip(colours[triangles[front]].mean(1) * shade[:, None], 0, 1)


def landmarks_in_view(
    scheme: landmarks.LandmarkScheme, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "L 3"], np.ndarray]:
    """Return a scheme's points on rotated vertices, and which of them lie on surfaces that face +Z."""
    corners = vertices[triangles]
    normals = np.zeros_like(vertices)
    np.add.at(normals, triangles, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None])
    return scheme.points(vertices), scheme.points(normals)[:, 2] > 0


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="left" if column in ("name", "parent", "names", "field") else "right")
    return table


def _scheme(scheme: landmarks.LandmarkScheme) -> str:
    order = {True: ", 2-6 of the right jaw reversed in the file", False: ""}[scheme.reversed_in_file]
    if scheme.name == jaw_order.SCHEME and not scheme.reversed_in_file:
        order = ", the jaw in the corrected order"
    return f"{scheme.name} ({len(scheme.indices)} points{order})"


def _file(path: Path, data: GNMData) -> Table:
    table = _table("file", "name", "field")
    digest = hash_file(path)
    source, licence = origin(path, digest)
    inside = [name for name in data.extra if name in gnm_npz.SCHEMA.names(path)]
    for name, value in (
        ("version", f"{data.version}, variant {data.variant}"),
        ("fields", f"the {len(gnm_npz.AXES)} of version {gnm_npz.VERSION}"),
        ("other fields", ", ".join(data.extra) or "none"),
        ("of these in the second file", ", ".join(name for name in data.extra if name not in inside) or "none"),
        ("size", f"{path.stat().st_size:,} bytes"),
        ("sha256 of the file", digest),
        ("content id", gnm_npz.content_hash(data)),
        ("topology id", gnm_npz.topology_hash(data.triangles)),
        ("source", source),
        ("licence", licence),
    ):
        table.add_row(name, Text(value, overflow="fold"))
    return table


def origin(path: Path, digest: str) -> tuple[str, str]:
    """Return where a GNM file of this sha256 comes from, and its licence, as far as that is known."""
    if (record := fetch.source_record(path)) is not None:
        return f"{record.get('source')}: {record.get('address')}", str(record.get("licence"))
    if digest == fetch.SHA256:
        return f"Google, release {gnm_npz.VERSION}", fetch.LICENCE
    if path.with_name(f"{path.stem}.manifest.json").is_file():
        return f"built; see {path.stem}.manifest.json", "that of the registrations it was built from"
    return "not recorded", "not recorded"


def _dimensions(data: GNMData) -> Table:
    table = _table("dimensions", "name", "count")
    for name, count in (
        ("vertices", len(data.template_vertex_positions)),
        ("triangles", len(data.triangles)),
        ("quads", len(data.quads)),
        ("identity", len(data.identity_names)),
        ("expression", len(data.expression_names)),
        ("joints", len(data.joint_names)),
        ("vertex groups", len(data.vertex_group_names)),
    ):
        table.add_row(name, f"{count:,}")
    table.add_row("pose correctives", "yes" if data.pose_correctives_regressor.any() else "all zero")
    return table


def _parts(data: GNMData) -> Table:
    table = _table("parts", "name", "vertices", "triangles")
    part = regions.components(data)
    for k, name in enumerate(data.mesh_component_names.tolist()):
        table.add_row(name, f"{(part == k).sum():,}", f"{(part[data.triangles[:, 0]] == k).sum():,}")
    return table


def _joints(data: GNMData) -> Table:
    table = _table("joints", "name", "parent", "x mm", "y mm", "z mm")
    names = data.joint_names.tolist()
    for name, parent, position in zip(names, data.joint_parent_indices, data.template_joint_positions, strict=True):
        table.add_row(name, names[parent] if parent >= 0 else "-", *(f"{c * MM_PER_M:.1f}" for c in position))
    return table


def _regions(data: GNMData) -> Table:
    table = _table("classes and vertex groups", "name", "vertices")
    names, membership = regions.vertex_classes(data)
    for name, count in zip(names, membership.sum(0), strict=True):
        table.add_row(f"[bold]class {name}[/]", f"{count:,.0f}")
    for role, mask in (("exterior", regions.exterior(data)), ("neck_other", regions.neck_other(data))):
        table.add_row(f"[bold]role {role}[/]", f"{mask.sum():,}")
    for name, weights in zip(data.vertex_group_names.tolist(), data.vertex_groups, strict=True):
        table.add_row(name, f"{(weights > 0).sum():,}")
    return table
