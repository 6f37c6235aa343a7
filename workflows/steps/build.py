"""The step that builds a round's model from its registrations."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coregister.next_model import provenance
from coregister.next_model.build import build_model
from coregister.next_model.recipes import ModelRecipe
from registration.errors import InputError
from registration.model import gnm_npz
from registration.progress import Progress, Silent
from registration.storage import hashing
from registration.storage.files import atomic_directory
from workflows.pages.model import write_model_page
from workflows.records.dataset import read_dataset
from workflows.records.training_subjects import Registered
from workflows.steps.products import STEP, JsonRecord, find_product, json_text

MODEL, PAGE = "gnm_head.npz", "index.html"


def build_next_model(
    *,
    run: str,
    names: Sequence[str],
    steady: str | None,
    dataset: str,
    previous: str,
    out: str,
    recipe: Mapping[str, Any],
    progress: Progress | None = None,
) -> JsonRecord:
    """Build the next model from registrations, stabilized expressions (`steady`) and the previous model.

    `recipe` is that of `ModelRecipe.to_json`.

    Raises:
        InputError: as `build_model`.
    """
    found, data = read_dataset(Path(dataset)), gnm_npz.read(Path(previous))
    tags = {name: found.tags(name) for name in names}
    place = None if steady is None else Path(steady)
    subjects = Registered(run=Path(run), names=names, model=data, steady=place, tags=tags)
    settings = ModelRecipe.from_json(recipe, where="the job's recipe")
    inputs = {**subjects.inputs, "previous": gnm_npz.content_hash(data)}
    wanted = hashing.input_hash(
        inputs, {"recipe": hashing.to_jsonable(settings), "categories": found.categories, "tags": tags}
    )
    known = find_product(Path(out), wanted)
    if known is not None and _is_model(Path(out) / MODEL, known["content_id"]):
        return {**known, "model": str(Path(out) / MODEL)}
    (progress or Silent()).note(f"building a model from {len(subjects.usable)} subjects")
    built = build_model(subjects, data, settings, categories=found.categories)
    told = {
        "input_hash": wanted,
        "model": str(Path(out) / MODEL),
        "content_id": built.manifest["content_id"],
        "registered": sum(1 + one["expressions"] for one in built.manifest["subjects"]),
        "rejected": built.manifest["rejected"],
        "components": built.manifest["identity"]["components"],
        "drift_mm": built.manifest["figures"]["drift_mm"],
    }
    with atomic_directory(Path(out)) as fresh:
        provenance.write(built.data, built.manifest, built.coefficients, fresh / MODEL, Path(previous))
        (fresh / PAGE).write_text(write_model_page(built.data, built.manifest), encoding="utf-8")
        (fresh / STEP).write_text(json_text(told), encoding="utf-8")
    return told


def _is_model(file: Path, content: str) -> bool:
    try:
        return gnm_npz.content_hash(gnm_npz.read(file)) == content
    except InputError:
        return False
