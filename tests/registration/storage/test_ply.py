"""PLY files as other programs write them must give the mesh that went in; damaged ones must be refused at once."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh

from registration.storage.mesh import write_ply
from registration.storage.ply import read_ply

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
POINTS, FACES = np.asarray(BALL.vertices).astype(np.float32), np.asarray(BALL.faces)
XYZ = "property float x\nproperty float y\nproperty float z\n"
CORNERS = "property list uchar int vertex_indices\n"
LETTERS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "int64": "q", "double": "d"}


def header(kind: str, *elements: str, eol: str = "\n", comment: bytes = b"") -> bytes:
    text = f"ply\nformat {kind} 1.0\n".encode() + comment + "".join(elements).encode() + b"end_header\n"
    return text.replace(b"\n", eol.encode())


def vertex(properties: str = XYZ, count: int = len(POINTS)) -> str:
    return f"element vertex {count}\n{properties}"


def face(properties: str = CORNERS, count: int = len(FACES)) -> str:
    return f"element face {count}\n{properties}"


def packed(rows: Sequence[Sequence[int]], count: str = "uchar", index: str = "int", order: str = "<") -> bytes:
    codes = order + LETTERS[count], order + "{}" + LETTERS[index]
    return b"".join(struct.pack(codes[0], len(r)) + struct.pack(codes[1].format(len(r)), *r) for r in rows)


def lines(rows: Sequence[Sequence[float]]) -> bytes:
    return b"".join(b" ".join(b"%.9g" % v for v in row) + b"\n" for row in rows)


LITTLE, BIG, TEXT = "binary_little_endian", "binary_big_endian", "ascii"
PLAIN = POINTS.tobytes() + packed(FACES.tolist())
GOOD: dict[str, bytes] = {
    "plain": header(LITTLE, vertex(), face()) + PLAIN,
    "big endian": header(BIG, vertex(), face()) + POINTS.astype(">f4").tobytes() + packed(FACES.tolist(), order=">"),
    "double": header(LITTLE, vertex(XYZ.replace("float", "double")), face())
    + POINTS.astype("<f8").tobytes()
    + packed(FACES.tolist()),
    "sized type names": header(LITTLE, vertex(XYZ.replace("float", "float32")), face(CORNERS.replace("int ", "int32 ")))
    + PLAIN,
    "header ends lines with CRLF": header(LITTLE, vertex(), face(), eol="\r\n") + PLAIN,
    "header ends lines with CR": header(LITTLE, vertex(), face(), eol="\r") + PLAIN,
    "Latin-1 comment": header(LITTLE, vertex(), face(), comment="comment TextureFile Müller.png\n".encode("latin-1"))
    + PLAIN,
    "comments that name keywords": header(
        LITTLE, vertex(), face(), comment=b"comment element vertex 7\nobj_info end_header\nobj_info num_cols 640\n"
    )
    + PLAIN,
    "faces before vertices": header(LITTLE, face(), vertex()) + packed(FACES.tolist()) + POINTS.tobytes(),
    "colours, normals, quality": header(
        LITTLE,
        vertex("property uchar red\n" + XYZ + "property double quality\nproperty float nx\n"),
        face(),
    )
    + b"".join(b"\x07" + p.tobytes() + struct.pack("<df", 0.5, np.nan) for p in POINTS)
    + packed(FACES.tolist()),
    "uvs of corners, texture number, colour of the face": header(
        LITTLE,
        vertex(),
        face("property uchar red\n" + CORNERS + "property list uchar float texcoord\nproperty int n\n"),
    )
    + POINTS.tobytes()
    + b"".join(b"\xff" + packed([f]) + struct.pack("<B6fi", 6, *range(6), 1) for f in FACES.tolist()),
    "lists of varying length before the corners": header(
        LITTLE, vertex(), face("property list uchar float texcoord\n" + CORNERS)
    )
    + POINTS.tobytes()
    + b"".join(struct.pack(f"<B{k % 3}f", k % 3, *range(k % 3)) + packed([f]) for k, f in enumerate(FACES.tolist())),
    "lists counted by int, corners as ushort": header(LITTLE, vertex(), face("property list int ushort vertex_index\n"))
    + POINTS.tobytes()
    + packed(FACES.tolist(), "int", "ushort"),
    "lists counted by ushort, corners as int64": header(
        BIG, vertex(), face("property list ushort int64 vertex_indices\n")
    )
    + POINTS.astype(">f4").tobytes()
    + packed(FACES.tolist(), "ushort", "int64", ">"),
    "corners under another name": header(LITTLE, vertex(), face("property list uchar uint corners\n"))
    + POINTS.tobytes()
    + packed(FACES.tolist(), index="uint"),
    "other elements before, between and after": header(
        LITTLE,
        "element camera 1\nproperty list uchar float view\nproperty float fx\n",
        vertex(),
        "element edge 2\nproperty int vertex1\nproperty int vertex2\n",
        face(),
        "element material 9\nproperty int id\n",
    )
    + struct.pack("<B2ff", 2, 0, 0, 1)
    + POINTS.tobytes()
    + struct.pack("<4i", 0, 1, 1, 2)
    + packed(FACES.tolist()),
    "text": header(TEXT, vertex(), face()) + lines(POINTS) + lines([[3, *f] for f in FACES]),
    "text, CRLF, blanks, exponents": header(TEXT, vertex(), face(), eol="\r\n")
    + b"\r\n".join(b"  %.9e\t%.9E %+.9g" % tuple(p) for p in POINTS)
    + b"\r\n"
    + lines([[3, *f] for f in FACES]),
    "text, normals of MSVC that are not numbers": header(TEXT, vertex(XYZ + "property float nx\n"), face())
    + b"".join(b"%.9g %.9g %.9g -1.#IND\n" % tuple(p) for p in POINTS)
    + lines([[3, *f] for f in FACES]),
    "upper-case coordinates": header(LITTLE, vertex(XYZ.replace(" x", " X")), face()) + PLAIN,
    "text after the body": header(TEXT, vertex(), face()) + lines(POINTS) + lines([[3, *f] for f in FACES]) + b"\n\n",
}


@pytest.mark.parametrize("name", GOOD)
def test_the_mesh_is_read_from_every_layout(tmp_path: Path, name: str) -> None:
    (tmp_path / "scan.ply").write_bytes(GOOD[name])
    mesh = read_ply(tmp_path / "scan.ply")
    np.testing.assert_allclose(mesh.vertices, POINTS, rtol=0, atol=1e-9)
    assert mesh.vertices.dtype == np.float64
    np.testing.assert_array_equal(mesh.triangles, FACES)
    assert mesh.faces == len(FACES)


def test_coordinates_far_from_the_origin_keep_double_precision(tmp_path: Path) -> None:
    far = POINTS.astype(np.float64) + [512345.25, 5403210.5, 412.125]
    data = header(LITTLE, vertex(XYZ.replace("float", "double"))) + far.tobytes()
    (tmp_path / "scan.ply").write_bytes(data)
    np.testing.assert_array_equal(read_ply(tmp_path / "scan.ply").vertices, far)


@pytest.mark.parametrize("text", [False, True])
def test_triangles_quads_polygons_and_lines_mixed(tmp_path: Path, text: bool) -> None:
    rows = [[0, 1, 2], [3, 4, 5, 6], [7, 8], [], [9, 10, 11, 12, 13], [1, 2, 3]]
    body = lines(POINTS) + lines([[len(r), *r] for r in rows]) if text else POINTS.tobytes() + packed(rows)
    data = header(TEXT if text else LITTLE, vertex(), face(count=len(rows))) + body
    (tmp_path / "scan.ply").write_bytes(data)
    mesh = read_ply(tmp_path / "scan.ply")
    fans = [[0, 1, 2], [3, 4, 5], [3, 5, 6], [9, 10, 11], [9, 11, 12], [9, 12, 13], [1, 2, 3]]
    np.testing.assert_array_equal(mesh.triangles, fans)
    assert mesh.faces == 6


def test_all_quads(tmp_path: Path) -> None:
    rows = [[0, 1, 2, 3], [4, 5, 6, 7]]
    (tmp_path / "scan.ply").write_bytes(header(LITTLE, vertex(), face(count=2)) + POINTS.tobytes() + packed(rows))
    np.testing.assert_array_equal(
        read_ply(tmp_path / "scan.ply").triangles, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    )


def test_triangle_strips_are_named_as_unread(tmp_path: Path) -> None:
    strips = "element tristrips 1\nproperty list int int vertex_indices\n"
    data = header(LITTLE, vertex(), strips) + POINTS.tobytes() + packed([[0, 1, 2, -1]], "int")
    (tmp_path / "scan.ply").write_bytes(data)
    mesh = read_ply(tmp_path / "scan.ply")
    assert mesh.triangles.shape == (0, 3) and mesh.faces == 0 and mesh.unread == {"tristrips": 1}


BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "no PLY file"),
    "an OBJ file": (b"v 0 0 0\nv 1 0 0\n", "no PLY file"),
    "gzip": (b"\x1f\x8b\x08\x00rest", "no PLY file"),
    "header cut short": (b"ply\nformat ascii 1.0\nelement ver", "no end_header"),
    "no format": (b"ply\nelement vertex 0\n" + XYZ.encode() + b"end_header\n", "format"),
    "unknown format": (header("binary_middle_endian", vertex()), "binary_middle_endian"),
    "unknown type": (header(LITTLE, vertex(XYZ.replace("float z", "quaternion z"))), "quaternion"),
    "no z": (header(LITTLE, vertex("property float x\nproperty float y\n")), "x, y and z"),
    "no vertices": (header(LITTLE, face()), '"vertex"'),
    "count below zero": (header(LITTLE, vertex(count=-3)), "count"),
    "count that is no number": (header(LITTLE, "element vertex many\n" + XYZ), "count"),
    "2^60 vertices": (header(LITTLE, vertex(count=2**59)) + POINTS.tobytes(), "cut short"),
    "2^60 vertices, text": (header(TEXT, vertex(count=2**59)) + lines(POINTS), "cut short"),
    "2^60 faces": (header(LITTLE, vertex(), face(count=2**60)) + PLAIN, "cut short"),
    "10^30 faces": (header(LITTLE, vertex(), face(count=10**30)) + PLAIN, "cut short"),
    "2^60 empty faces": (
        header(LITTLE, "element face 576460752303423488\n" + CORNERS, vertex()) + bytes(1000),
        "cut short",
    ),
    "body cut short": (header(LITTLE, vertex(), face()) + PLAIN[:-5], "cut short"),
    "text cut short": (header(TEXT, vertex(), face()) + lines(POINTS) + lines([[3, *f] for f in FACES])[:-9], "cut"),
    "no body": (header(LITTLE, vertex(), face()), "cut short"),
    "decimal commas": (header(TEXT, vertex(count=1)) + b"0,1 0,2 0,3\n", "0,1"),
    "a face of 4 billion corners": (
        header(LITTLE, vertex(), face("property list uint int vertex_indices\n", 1))
        + POINTS.tobytes()
        + b"\xff\xff\xff\xff\0\0\0\0",
        "cut short",
    ),
    "a list of length -1": (
        header(LITTLE, vertex(), face("property list char int vertex_indices\n", 1)) + POINTS.tobytes() + b"\xff" * 5,
        "length -1",
    ),
    "corners that are no integers": (
        header(TEXT, vertex(count=3), face(count=1)) + b"0 0 0 " * 3 + b"3 0 1 1.5",
        "int",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_damaged_file_is_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    data, message = BAD[name]
    (tmp_path / "scan.ply").write_bytes(data)
    with pytest.raises(ValueError) as error:
        read_ply(tmp_path / "scan.ply")
    assert message in str(error.value)


@pytest.mark.parametrize("source", GOOD)
def test_any_damage_gives_a_mesh_or_a_reason(tmp_path: Path, source: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(GOOD[source])
        for at in rng.integers(0, 600, rng.integers(0, 4)):
            data[at : at + 4] = rng.bytes(int(rng.integers(1, 7)))
        keep = 1.0 if rng.random() < 0.5 else rng.random()
        (tmp_path / "scan.ply").write_bytes(data[: int(keep * len(data))])
        try:
            mesh = read_ply(tmp_path / "scan.ply")
        except ValueError:
            continue
        assert mesh.vertices.shape[1:] == (3,) and mesh.triangles.shape[1:] == (3,)


def test_what_this_project_writes_is_read_back(tmp_path: Path) -> None:
    write_ply(tmp_path / "mesh.ply", POINTS, FACES)
    mesh = read_ply(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(mesh.vertices.astype(np.float32), POINTS)
    np.testing.assert_array_equal(mesh.triangles, FACES)
