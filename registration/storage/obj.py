"""Read Wavefront OBJ files: vertices with or without colours, polygons of any size, groups, uvs, materials."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from registration.storage.mesh_files import MAX_ELEMENTS, MeshFile, fans, inside_folder

_MAX_MATERIAL_BYTES = 2**24
_SURFACES = (b"curv", b"curv2", b"surf", b"bmat", b"bzp", b"bsp", b"cdc", b"cdp", b"res")  # free-form: not read
_MAP_OPTION = re.compile(r"^-(?:[ost]\s+\S+(?:\s+[-+.\d]\S*){0,2}|mm\s+\S+\s+\S+|\w+\s+\S+)\s+")


@dataclass(kw_only=True)
class _Lines:
    """The statements of a file, still as text."""

    vertices: list[bytes] = field(default_factory=list)
    uvs: list[bytes] = field(default_factory=list)
    corners: list[bytes] = field(default_factory=list)  # v, v/vt, v//vn or v/vt/vn
    counts: list[int] = field(default_factory=list)  # corners of each face
    materials: list[int] = field(default_factory=list)  # of each face, index into `names`
    names: list[str] = field(default_factory=lambda: [""])
    libraries: list[str] = field(default_factory=list)
    unread: dict[str, int] = field(default_factory=dict)


def read_obj(path: Path) -> MeshFile:
    """Read an OBJ file. A missing material file or texture is no error: `notes` says so.

    Raises:
        ValueError: a line is malformed, an index names a missing vertex, or there are too many of something.
        OSError: the file cannot be read.
    """
    lines = _statements(path.read_bytes())
    vertices, colours = _vertices(lines.vertices)
    uvs = _table(lines.uvs, "vt")[:, :2] if lines.uvs else np.zeros((0, 2))
    index = _corners(lines.corners)
    place = fans(np.asarray(lines.counts, np.int64))
    corner_vertex = _checked(index[:, 0], len(vertices), "a vertex")
    corner_uv = _checked(index[:, 1], len(uvs), "a texture coordinate", optional=True)
    face_of = np.repeat(np.arange(len(lines.counts)), np.maximum(np.asarray(lines.counts, np.int64) - 2, 0))
    files, notes = _textures(path.parent, lines)
    textures = [file for file in dict.fromkeys(files) if file is not None]
    of_material = np.array([-1 if file is None else textures.index(file) for file in files], np.int64)
    has_uv = bool((corner_uv >= 0).any())
    padded = np.concatenate([uvs, np.full((1, 2), np.nan)])  # -1: a corner without
    return MeshFile(
        vertices=vertices,
        triangles=corner_vertex[place],
        colours=colours,
        corner_uvs=padded[corner_uv[place]] if has_uv else None,
        face_textures=of_material[np.asarray(lines.materials, np.int64)[face_of]] if has_uv and textures else None,
        textures=tuple(textures) if has_uv else (),
        unread=lines.unread,
        notes=notes,
    )


def _statements(data: bytes) -> _Lines:
    """Sort the lines by what they state. Raises ValueError for a face with an index of 0, or too many lines."""
    if b"\0" in data[:4096]:
        raise ValueError("a binary file, not the text of an OBJ file")
    lines, material = _Lines(), 0
    material_index = {"": 0}
    for number, line in enumerate(re.sub(rb"\\\r?\n", b" ", data).splitlines(), 1):
        keyword, _, rest = line.strip().partition(b" ") if b"\t" not in line else _split_tab(line)
        if keyword == b"v":
            lines.vertices.append(rest)
        elif keyword == b"vt":
            lines.uvs.append(rest)
        elif keyword == b"f":
            words = rest.split(b"#")[0].split()
            if b"-" in rest:
                words = [_absolute(word, len(lines.vertices), len(lines.uvs), number) for word in words]
            lines.corners += words
            lines.counts.append(len(words))
            lines.materials.append(material)
        elif keyword == b"usemtl":
            name = rest.strip().decode("utf-8", "replace")
            material = material_index.setdefault(name, len(material_index))
        elif keyword == b"mtllib":
            lines.libraries.append(rest.strip().decode("utf-8", "replace"))
        elif keyword in _SURFACES or keyword in (b"l", b"p"):
            name = keyword.decode()
            lines.unread[name] = lines.unread.get(name, 0) + 1
    lines.names = list(material_index)
    if max(len(lines.vertices), len(lines.uvs), len(lines.corners)) > MAX_ELEMENTS:
        raise ValueError(f"more than {MAX_ELEMENTS} vertices or corners")
    if not lines.vertices:
        raise ValueError("no line that begins with v: no vertices")
    return lines


def _split_tab(line: bytes) -> tuple[bytes, bytes, bytes]:
    words = line.strip().split(None, 1)
    return (words[0] if words else b"", b" ", words[1] if len(words) > 1 else b"")


def _absolute(word: bytes, vertices: int, uvs: int, line: int) -> bytes:
    """A corner with negative indices, which count back from the last vertex so far, as one with positive ones."""
    parts = word.split(b"/")
    for place, count in enumerate((vertices, uvs)):
        if place < len(parts) and parts[place].startswith(b"-"):
            try:
                value = count + 1 + int(parts[place])
            except ValueError:
                raise ValueError(f"line {line}: {word[:40]!r} is no corner of a face") from None
            if value < 1:
                raise ValueError(f"line {line}: the index {int(parts[place])} counts back beyond the first of {count}")
            parts[place] = str(value).encode()
    return b"/".join(part for part in parts[:2])


def _vertices(rows: Sequence[bytes]) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"] | None]:
    """Positions, and colours where a line has six or seven numbers; homogeneous weights other than 1 are refused."""
    table = _table(rows, "v")
    width = table.shape[1]
    if width < 3:
        raise ValueError(f"vertices of {width} coordinates")
    if width in (4, 7) and not np.isin(table[:, 3], (1.0,)).all():
        raise ValueError("vertices with a weight other than 1: rational surfaces are not read")
    if width not in (6, 7):
        return table[:, :3], None
    colours = table[:, -3:]
    top = np.nanmax(colours, initial=0.0)
    return table[:, :3], np.clip(np.nan_to_num(colours) / (255.0 if top > 1.0 else 1.0), 0, 1)


def _table(rows: Sequence[bytes], keyword: str) -> Float[np.ndarray, "N K"]:
    """The numbers of lines that all have equally many; lines with more are cut to the shortest."""
    values = [row.split(b"#")[0].split() if b"#" in row else row.split() for row in rows]
    width = min(map(len, values))
    words = [word for row in values for word in row[:width]]
    try:
        return np.array(words, "S").astype(np.float64).reshape(len(rows), width)
    except ValueError:
        for number, row in enumerate(values, 1):
            for word in row[:width]:
                try:
                    float(word)
                except ValueError:
                    shown = word[:40].decode("latin-1")
                    raise ValueError(f"{shown!r} in the {number}. line {keyword} is not a number") from None
        raise


def _corners(words: Sequence[bytes]) -> Int[np.ndarray, "C 2"]:
    """Indices from 0 of vertex and uv of each corner; -1 for a missing uv."""
    if not words:
        return np.zeros((0, 2), np.int64)
    if b"/" not in b"".join(words[:1]) and not any(b"/" in word for word in words):
        pairs = [(word, b"0") for word in words]
    else:
        pairs = [((parts := word.split(b"/"))[0], (parts[1] if len(parts) > 1 else b"") or b"0") for word in words]
    try:
        table = np.array(pairs, "S").astype(np.int64)
    except (ValueError, OverflowError):
        wrong = next(p for p in pairs if not (p[0].isdigit() and p[1].isdigit()))
        raise ValueError(f"{b'/'.join(wrong)[:40].decode('latin-1')!r} is no corner of a face") from None
    return table - 1


def _checked(index: Int[np.ndarray, "C"], count: int, what: str, optional: bool = False) -> Int[np.ndarray, "C"]:
    """Indices that all exist. Raises ValueError for one that does not."""
    wrong = (index >= count) | (index < (-1 if optional else 0))
    if wrong.any():
        raise ValueError(f"a face names {what} {int(index[wrong][0]) + 1} of {count}")
    return index


def _textures(folder: Path, lines: _Lines) -> tuple[list[Path | None], tuple[str, ...]]:
    """The colour image of each material, and what is missing."""
    maps: dict[str, str] = {}
    notes = []
    for library in lines.libraries:
        file = inside_folder(folder, library)
        if file is None or file.stat().st_size > _MAX_MATERIAL_BYTES:
            notes.append(f"its material file {library[:80]} is not beside it")
            continue
        maps |= _colour_maps(file.read_bytes().decode("utf-8", "replace"))
    files: list[Path | None] = []
    for name in lines.names:
        image = maps.get(name)
        file = None if image is None else inside_folder(folder, image)
        if image is not None and file is None:
            notes.append(f"its texture {image[:80]} is not beside it")
        files.append(file)
    return files, tuple(notes)


def _colour_maps(text: str) -> dict[str, str]:
    """Material -> the name of the image with its diffuse colour."""
    maps, material = {}, ""
    for line in text.splitlines():
        keyword, _, rest = line.strip().partition(" ")
        if keyword == "newmtl":
            material = rest.strip()
        elif keyword.lower() == "map_kd" or (keyword.lower() == "map_ka" and material not in maps):
            rest = rest.strip()
            while option := _MAP_OPTION.match(rest):
                rest = rest[option.end() :]
            maps[material] = rest
    return maps
