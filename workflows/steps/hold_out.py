"""The step that gathers held-out subjects into the file on which models are evaluated."""

from collections.abc import Sequence
from pathlib import Path

from registration.model import gnm_npz
from registration.progress import Progress
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage import hashing
from registration.storage.files import atomic_write_text
from registration.storage.registration_folder import read_manifest
from workflows.records.dataset import Dataset, read_dataset
from workflows.records.subject import read_usable
from workflows.records.training_subjects import (
    has_truths,
    held_out,
    registered_meshes,
    true_meshes,
    write_held_out,
)
from workflows.steps.products import STEP, JsonRecord, find_product, json_text

PEOPLE = "people.npz"


def hold_out(
    *, dataset: str, names: Sequence[str], registrations: str, model: str, out: str, progress: Progress | None = None
) -> JsonRecord:
    """Held-out subjects -> one NPZ file to measure models on: true meshes where captures have them, of the model's
    topology, else the registrations in `registrations`. Subjects that have neither are told.

    Raises InputError for truths and registrations that cannot be read.
    """
    data, found = gnm_npz.read(Path(model)), read_dataset(Path(dataset))
    true = [name for name in names if has_truths(found.subjects[name], data)]
    inputs = {"topology": gnm_npz.topology_hash(data.triangles)}
    for name in names:
        inputs[name] = hashing.input_hash(_sources(found, Path(registrations), name, name in true), found.tags(name))
    wanted = hashing.input_hash(inputs, {"categories": found.categories})
    place = Path(out)
    if (known := find_product(place, wanted)) is not None and (place / PEOPLE).is_file():
        return {**known, "people": str(place / PEOPLE)}
    people, lost, skin = [], list[str](), SkullSkin.of(data)
    for name in names:
        meshes = true_meshes(found.subjects[name], data) if name in true else None
        meshes = meshes or registered_meshes(Path(registrations) / name, data)
        if meshes is None:
            lost.append(name)
            continue
        people.append(held_out(name, meshes, skin, found.categories, found.tags(name)))
    write_held_out(people, data.triangles, place / PEOPLE)
    sources = {one.subject: "true meshes" if one.subject in true else "registrations" for one in people}
    told = {"input_hash": wanted, "people": str(place / PEOPLE), "sources": sources, "lost": lost}
    atomic_write_text(place / STEP, json_text(told))
    return told


def _sources(found: Dataset, registrations: Path, name: str, true: bool) -> dict[str, str]:
    """Digests of what a held-out subject is read from."""
    if true:
        truths = [(c.root.name, c.expression, c.ground_truth) for c in found.subjects[name].captures]
        return {f"{folder} {label}": hashing.hash_file(file) for folder, label, file in truths if file is not None}
    one = read_usable(registrations / name)
    folders = () if one is None else (one.neutral, *one.expressions)
    return {folder: str(read_manifest(registrations / name / folder).content_id) for folder in folders}
