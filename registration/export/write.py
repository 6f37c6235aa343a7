"""Write a head in the format of a file's suffix: the table of formats, and what each can hold."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from registration.errors import InputError
from registration.export.alembic import MODULE as ALEMBIC
from registration.export.alembic import write_abc
from registration.export.glb import glb_bytes, png_bytes
from registration.export.head_mesh import HeadMesh
from registration.export.usd import MODULE as USD_MODULE
from registration.export.usd import write_usda, write_usdc, write_usdz
from registration.storage.files import check_output_file, naming_full_disk
from registration.storage.mesh import write_obj, write_ply


@dataclass(frozen=True, kw_only=True)
class Format:
    """A file format, and which parts of a head it can hold."""

    write: Callable[[HeadMesh, Path, str | None], None]  # head, file, name of the texture's file if it is beside it
    quads: bool = True
    texture: bool = True
    texture_beside: bool = True  # the texture is a file of its own
    materials: bool = True
    shapes: bool = False
    frames: bool = False
    companions: tuple[str, ...] = ()  # suffixes of further files
    module: str | None = None  # that must be installed, and its package
    package: str = ""


def _write_obj(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    topology = mesh.topology
    members = {name: np.flatnonzero(topology.face_material == number) for number, name in enumerate(topology.materials)}
    write_obj(file, mesh.vertices, topology.faces, topology.face_uvs, texture, members)


def _write_ply(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    write_ply(file, mesh.vertices, mesh.topology.faces)


def _write_glb(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    file.write_bytes(glb_bytes(mesh))


FORMATS: Mapping[str, Format] = {
    ".obj": Format(write=_write_obj, companions=(".mtl",)),
    ".ply": Format(write=_write_ply, texture=False, materials=False),
    ".glb": Format(write=_write_glb, quads=False, texture_beside=False, shapes=True),
    ".usda": Format(write=write_usda, shapes=True, frames=True),
    ".usd": Format(write=write_usda, shapes=True, frames=True),
    ".usdc": Format(write=write_usdc, shapes=True, frames=True, module=USD_MODULE, package="usd-core"),
    ".usdz": Format(
        write=write_usdz, texture_beside=False, shapes=True, frames=True, module=USD_MODULE, package="usd-core"
    ),
    ".abc": Format(write=write_abc, frames=True, module=ALEMBIC, package=ALEMBIC),
}


def format_of(file: Path) -> Format:
    """Return the format of a file's suffix. Raises InputError, which lists the formats, for another suffix."""
    found = FORMATS.get(file.suffix.lower())
    if found is None:
        raise InputError(
            "There is no format of this suffix",
            where=file,
            expected=f"a file's name with one of {', '.join(FORMATS)}",
            got=file.suffix or "no suffix",
            fix="choose one of them",
        )
    return found


def check_out(file: Path, *, replace: bool, filled: bool = False) -> None:
    """Refuse, before any work, a file that cannot be written.

    Args:
        file: where the export goes.
        replace: replace files that are there.
        filled: a filled texture is written, with the mask of what was filled.

    Raises:
        InputError: no format has its suffix, the package that the format needs is not installed, it is a folder, or it
            or a file that belongs to it exists, or it cannot hold the texture that is to be filled.
    """
    kind = format_of(file)
    if kind.module is not None and find_spec(kind.module) is None:
        others = ", ".join(suffix for suffix, other in FORMATS.items() if other.module is None)
        raise InputError(
            f"The package {kind.package} is not installed",
            where=file,
            expected=f"{kind.package}, which writes {file.suffix} files",
            got="none",
            fix=f"pip install {kind.package}, or choose one of {others}",
        )
    check_output_file(file)
    if filled and not kind.texture:
        raise InputError(
            "The format has no texture to fill",
            where=file,
            expected=f"one of {', '.join(suffix for suffix, other in FORMATS.items() if other.texture)}",
            got=file.suffix,
            fix="choose one of them, or leave out --fill and --fill-from",
        )
    suffixes = (file.suffix, *kind.companions, *([".png"] if kind.texture and kind.texture_beside else []))
    for path in (*(file.with_suffix(suffix) for suffix in suffixes), *([mask_file(file)] if filled else [])):
        check_output_file(path)
        if path.exists() and not replace:
            raise InputError(
                "The output file exists",
                where=path,
                expected="a new file",
                got="a file",
                fix="add --force to replace it",
            )


def mask_file(file: Path) -> Path:
    """Return the image beside an exported file that is white where the texture was filled."""
    return file.with_name(f"{file.stem}_unseen.png")


def check_fits(file: Path, *, shapes: bool, frames: bool) -> None:
    """Refuse a format that cannot hold what is to be exported.

    Args:
        file: of a known suffix.
        shapes: there are expressions.
        frames: it is a sequence.

    Raises:
        InputError: the head has shapes or frames, and the format has none.
    """
    kind = format_of(file)
    for present, able, what in (
        (shapes, "shapes", "expressions"),
        (frames, "frames", "a sequence"),
    ):
        if present and not getattr(kind, able):
            capable = [suffix for suffix, other in FORMATS.items() if getattr(other, able)]
            raise InputError(
                f"The format cannot hold {what}",
                where=file,
                expected=f"one of {', '.join(capable)}",
                got=file.suffix,
                fix="choose one of them, or export a single registration",
            )


def write(mesh: HeadMesh, file: Path) -> list[Path]:
    """Write a head, and its texture and materials beside it where the format has them so. Each file in one rename.

    Args:
        mesh: the head.
        file: of a known suffix; files that are there are replaced.

    Returns:
        The files.

    Raises:
        InputError: as `format_of` and `check_fits`; numbers that are not finite.
    """
    kind = format_of(file)
    check_fits(file, shapes=bool(mesh.shapes), frames=mesh.frames is not None)
    for name, values in {"vertices": mesh.vertices, "frames": mesh.frames, **mesh.shapes}.items():
        if values is not None and not np.isfinite(values).all():
            raise InputError(
                "The head is not finite",
                where=f"{mesh.name}, {name}",
                expected="finite numbers",
                got=f"{np.count_nonzero(~np.isfinite(values))} NaN or infinite",
                fix="register or stabilize again",
            )
    file.parent.mkdir(parents=True, exist_ok=True)
    beside = mesh.texture is not None and kind.texture and kind.texture_beside
    texture = file.with_suffix(".png").name if beside else None
    with naming_full_disk(file), TemporaryDirectory(dir=file.parent, prefix=f".{file.stem}.", suffix=".tmp") as folder:
        kind.write(mesh, Path(folder) / file.name, texture)
        if beside and mesh.texture is not None:
            (Path(folder) / file.with_suffix(".png").name).write_bytes(png_bytes(mesh.texture))
        if mesh.unseen is not None:
            (Path(folder) / mask_file(file).name).write_bytes(png_bytes(mesh.unseen))
        names = sorted((path.name for path in Path(folder).iterdir()), key=lambda name: (name == file.name, name))
        for name in names:  # the file that names the others comes last
            os.replace(Path(folder) / name, file.with_name(name))
    return [file.with_name(name) for name in reversed(names)]


def left_out(mesh: HeadMesh, file: Path) -> list[str]:
    """Return what of a head the format does not hold, for people."""
    kind = format_of(file)
    notes = []
    if mesh.texture is not None and not kind.texture:
        notes.append("the texture and the uvs")
    if not kind.materials:
        notes.append("the materials of the parts")
    if not kind.quads:
        notes.append("the quads: the format has triangles")
    return notes
