"""The source of `gnmreg export`: which folder or file it is, the model that belongs to it, and its head."""

from dataclasses import dataclass
from pathlib import Path

from registration.errors import InputError
from registration.export.head_mesh import HeadMesh
from registration.export.options import ExportOptions
from registration.export.registrations import head_of_model, head_of_registration
from registration.model import gnm_npz
from registration.model.fetch import cached_path
from registration.model.gnm_npz import GNMData
from registration.storage.cache import cache_folder
from registration.storage.registration_folder import is_registration, load_registration
from registration.types import Registration


@dataclass(frozen=True, kw_only=True)
class ExportSource:
    """What is exported."""

    head: HeadMesh
    notes: tuple[str, ...] = ()  # for people


def read_source(
    source: Path,
    model: Path | None,
    options: ExportOptions = ExportOptions(),  # noqa: B008  frozen
) -> ExportSource:
    """Read what is to be exported.

    Args:
        source: a registration folder, or a model's NPZ file.
        model: file of the head model of the registrations; None: the one that they name, or the cached one.
        options: of the export.

    Raises:
        InputError: it is nothing of this kind, it cannot be read, a registration failed, or its model is not found.
    """
    if source.is_file():
        return ExportSource(head=head_of_model(gnm_npz.read(source), name=source.stem, shapes={}))
    if is_registration(source):
        registration = load_registration(source)
        data = find_model(registration, model, source)
        return ExportSource(head=head_of_registration(registration, data, name=source.name, options=options))
    raise InputError(
        "There is nothing to export",
        where=source,
        expected="a registration folder, or a model's NPZ file",
        got="a folder with other contents" if source.is_dir() else "no such file or folder",
        fix="give a folder that `gnmreg register` wrote",
    )


def find_model(registration: Registration, given: Path | None, where: Path) -> GNMData:
    """Return the model that a registration was made with.

    Args:
        registration: names its model's file, and the digest of its content.
        given: the model's file; any of the same topology. None: look where the registration names it, and in the cache.
        where: the registration's folder, for messages.

    Raises:
        InputError: the given file is no model or has another topology; or there is none of that content.
    """
    topology = gnm_npz.topology_hash(registration.triangles)
    if given is not None:
        data = gnm_npz.read(given)
        if gnm_npz.topology_hash(data.triangles) != topology:
            raise InputError(
                "The model has another topology than the registration",
                where=given,
                expected=f"the registration's {len(registration.triangles)} triangles, in their order",
                got=f"{len(data.triangles)} triangles, or another order",
                fix="give the model that the capture was registered with",
            )
        return data
    content = registration.inputs.get("model")
    named = registration.provenance.get("model")
    candidates = [Path(named)] if named else []
    for file in (*candidates, cached_path(), *sorted(cache_folder().glob("first-*/*.npz"))):
        if file.is_file():
            try:
                data = gnm_npz.read(file)
            except InputError:
                continue  # another file has taken its place
            if gnm_npz.content_hash(data) == content:
                return data
    raise InputError(
        "The head model of this registration is not found",
        where=where,
        expected="the model where it was when the capture was registered, or in the cache",
        got=f"no model of sha256 {str(content)[:16]}" + (f" at {named}" if named else ""),
        fix="give its file with --model",
    )
