"""The step that gathers held-out subjects into the file on which models are evaluated."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from registration.model import gnm_npz
from registration.progress import Progress
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage.hashing import hash_file, input_hash
from registration.storage.registration_folder import read_manifest
from workflows.records.dataset import Dataset, read_dataset
from workflows.records.step_results import HoldOutResult
from workflows.records.subject import read_usable
from workflows.records.training_subjects import (
    has_truths,
    held_out,
    registered_meshes,
    true_meshes,
    write_held_out,
)
from workflows.steps.coregistration_page import shown_on_page
from workflows.steps.products import Product

HELD_OUT = "held_out.npz"


@shown_on_page()
def hold_out(
    *, dataset: str, names: Sequence[str], registrations: str, model: str, out: str, progress: Progress | None = None
) -> dict[str, Any]:
    """Write one NPZ file of held-out subjects: their true meshes where captures have them, else their registrations.

    Args:
        dataset: its folder.
        names: folder names of the held-out subjects.
        registrations: folder of the subject folders of those without true meshes of the model's topology.
        model: defines the topology.
        out: folder of the product.
        progress: unused; the step is short.

    Returns:
        A `HoldOutResult` as JSON.

    Raises:
        InputError: a true mesh, registration or record cannot be read.
    """
    data, source = gnm_npz.read(Path(model)), read_dataset(Path(dataset))
    with_truths = [name for name in names if has_truths(source.subjects[name], data)]
    digests = {"topology": gnm_npz.topology_hash(data.triangles)}
    for name in names:
        digests[name] = input_hash(_digests(source, Path(registrations), name, name in with_truths), source.tags(name))
    file = Path(out) / HELD_OUT
    product = Product(Path(out), input_hash(digests, {"categories": source.categories}), HoldOutResult)
    if (existing := product.find()) is not None and file.is_file():
        return replace(existing, file=str(file)).to_json()
    subjects, lost, skin = [], list[str](), SkullSkin.from_model(data)
    for name in names:
        meshes = true_meshes(source.subjects[name], data) if name in with_truths else None
        meshes = meshes or registered_meshes(Path(registrations) / name, data)
        if meshes is None:
            lost.append(name)
            continue
        subjects.append(held_out(name, meshes, skin, source.categories, source.tags(name)))
    write_held_out(subjects, data.triangles, file)
    result = HoldOutResult(
        input_hash=product.input_hash,
        file=str(file),
        sources={s.subject: "true meshes" if s.subject in with_truths else "registrations" for s in subjects},
        lost=tuple(lost),
    )
    product.write(result)
    return result.to_json()


def _digests(dataset: Dataset, registrations: Path, name: str, has_truth: bool) -> dict[str, str]:
    """Digests of the files that a held-out subject is read from."""
    if has_truth:
        truths = [(c.root.name, c.expression, c.ground_truth) for c in dataset.subjects[name].captures]
        return {f"{folder} {label}": hash_file(file) for folder, label, file in truths if file is not None}
    usable = read_usable(registrations / name)
    folders = () if usable is None else (usable.neutral, *usable.expressions)
    return {folder: read_manifest(registrations / name / folder).content_id for folder in folders}
