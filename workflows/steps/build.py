"""The step that builds a round's model from its registrations."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister.anatomy.assemble import AnatomySettings, regenerate
from coregister.anatomy.tongue import TongueSources
from coregister.next_model import provenance
from coregister.next_model.build import BuiltModel, build_model
from coregister.next_model.expression_outliers import REPORTED_FIGURES
from coregister.next_model.recipes import ModelRecipe
from coregister.next_model.training_data import TrainingSubject
from registration.cranium import auxiliary_model
from registration.errors import InputError
from registration.model import gnm_npz
from registration.progress import NullProgress, Progress
from registration.storage import hashing
from registration.storage.files import atomic_directory
from workflows.gate.figures import read_figures
from workflows.pages.model import render_model_page
from workflows.records.dataset import read_dataset
from workflows.records.step_results import BuildResult, RejectedRegistration
from workflows.records.training_subjects import RegisteredSubjects
from workflows.steps.coregistration_page import shown_on_page
from workflows.steps.gate import read_gate
from workflows.steps.products import Product

MODEL, PAGE = "gnm_head.npz", "index.html"


@shown_on_page()
def build_next_model(
    *,
    run: str,
    names: Sequence[str],
    made: Mapping[str, str],
    dataset: str,
    previous: str,
    out: str,
    recipe: Mapping[str, Any],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Build the next model from registrations, stabilized expressions and the previous model.

    Args:
        run: folder of the subject folders.
        names: of the subject folders to use.
        made: what else the build takes, by kind: "stabilized", the folder without which neutrals alone are used;
            "gate", the folder of the gate's record, without which all usable registrations are used; "first", the file
            of the coregistration's first model, which has seen none of the subjects: identity is shrunk towards it,
            without it towards the previous model.
        dataset: its folder, for tags and categories.
        previous: file of the previous model.
        out: folder of the model.
        recipe: a `ModelRecipe` as JSON; and "anatomy", if parts of the built model are regenerated: their names
            ("parts") and the seed ("seed").
        progress: where to report to.

    Returns:
        A `BuildResult` as JSON.

    Raises:
        InputError: as `build_model`, or a record is malformed.
    """
    source, data = read_dataset(Path(dataset)), gnm_npz.read(Path(previous))
    tags = {name: source.tags(name) for name in names}
    stabilized_set = Path(made["stabilized"]) if "stabilized" in made else None
    gated = read_gate(made.get("gate"))
    subjects = RegisteredSubjects(
        run=Path(run),
        names=names,
        model=data,
        stabilized_set=stabilized_set,
        tags=tags,
        left_out=frozenset(gated.left_out if gated else ()),
        figures_of=_outlier_figures,
    )
    recipe = dict(recipe)
    anatomy = recipe.pop("anatomy", None)
    settings = ModelRecipe.from_json(recipe, where="the job's recipe")
    first = made.get("first", previous)
    prior = data if first == previous else gnm_npz.read(Path(first))
    inputs = {**subjects.inputs, "previous": gnm_npz.content_hash(data), "prior": gnm_npz.content_hash(prior)}
    cranium = auxiliary_model.find(Path(previous), data) if settings.completion.cranium == "model" else None
    if cranium is not None:
        inputs["cranium"] = hashing.hash_fields(cranium)
    config = {"recipe": hashing.to_jsonable(settings), "categories": source.categories, "tags": tags}
    if anatomy:
        config["anatomy"] = anatomy
    if gated:  # the log's head changes with decisions about other runs
        config["gate"] = {name: value for name, value in gated.to_json().items() if name != "log_head"}
    folder = Path(out)
    product = Product(folder, hashing.input_hash(inputs, config), BuildResult)
    if (existing := product.find()) is not None and _is_model(folder / MODEL, existing.content_id):
        return replace(existing, model=str(folder / MODEL)).to_json()
    (progress or NullProgress()).message(f"building a model from {len(subjects.usable)} subjects")
    built = build_model(subjects, data, settings, categories=source.categories, cranium=cranium, prior=prior)
    if anatomy:
        regenerated = AnatomySettings(parts=tuple(anatomy["parts"]), seed=anatomy["seed"])
        (progress or NullProgress()).message(f"regenerating {', '.join(regenerated.parts)}")
        built = _with_anatomy(built, regenerated, subjects)
    if gated:
        built = replace(built, manifest=built.manifest | {"gate": gated.to_json()})
    result = BuildResult(
        input_hash=product.input_hash,
        model=str(folder / MODEL),
        content_id=built.manifest["content_id"],
        registered=sum(1 + subject["expressions"] for subject in built.manifest["subjects"]),
        rejected=tuple(RejectedRegistration(**rejected) for rejected in built.manifest["rejected"]),
        components=built.manifest["identity"]["components"],
        drift_mm=built.manifest["figures"]["drift_mm"],
    )
    with atomic_directory(folder) as temporary:
        provenance.write(built.data, built.manifest, built.coefficients, temporary / MODEL, Path(previous))
        (temporary / PAGE).write_text(render_model_page(built.data, built.manifest), encoding="utf-8")
        product.write(result, temporary)
    return result.to_json()


def _outlier_figures(figures: Mapping[str, Any]) -> dict[str, float]:
    return {name: value for name, value in read_figures(figures).known().items() if name in REPORTED_FIGURES}


def _with_anatomy(built: BuiltModel, settings: AnatomySettings, subjects: Iterable[TrainingSubject]) -> BuiltModel:
    """The built model with regenerated parts, which its manifest describes in a section of its own.

    The tongue is posed in the open mouths of the registrations, and where there are few of these, in the model's own.
    """
    rejected = {entry["name"] for entry in built.manifest["rejected"]}
    tongues = None
    if "tongue" in settings.parts:
        tongues = TongueSources(expressions=list(_expressions(subjects, rejected)), fill=True)
    made = regenerate(built.data, settings, tongues)
    described = {"content_id": gnm_npz.content_hash(made.data), "anatomy": made.anatomy}
    return replace(built, data=made.data, manifest=built.manifest | described)


def _expressions(subjects: Iterable[TrainingSubject], rejected: Collection[str]) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Displacements of expressions from their neutrals, without registrations that are not in the model; metres."""
    for subject in subjects:
        if subject.neutral is not None and subject.name not in rejected:
            for mesh in subject.expressions:
                if f"{subject.name}, {mesh.name}" not in rejected:
                    yield mesh.vertices - subject.neutral.vertices


def _is_model(file: Path, content: str) -> bool:
    try:
        return gnm_npz.content_hash(gnm_npz.read(file)) == content
    except InputError:
        return False
