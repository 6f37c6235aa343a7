"""The durable steps of coregistration: each loads, makes ONE public call, saves, and tells of it in JSON values.

They meet only through named products on disk. A product that was made from the same inputs is there already and is
told at once; a step that is interrupted leaves none, so that any of them may be called again at any time, which is what
flows (`flows.py`) rely on.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coregister import stopping_rule as deciding
from coregister.evaluate.evaluation import Settings
from coregister.evaluate.linear_fit import identity_part
from coregister.next_model import provenance
from coregister.next_model.build import Build
from coregister.next_model.build import build as build_model
from coregister.next_model.identity import Identity
from registration.errors import InputError
from registration.fit.recipes import recipe_named
from registration.model import gnm_npz
from registration.model.landmarks import schemes_beside
from registration.progress import Progress, Silent
from registration.stabilize import stabilized_folder as stabilized
from registration.stabilize.components import LEAST_SAMPLES
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage import hashing
from registration.storage.registration_folder import fresh_folder, read_manifest, swap_in
from workflows.pages.model import write_model_page
from workflows.records.dataset import Dataset, read_dataset
from workflows.records.subject import read_captures, read_usable
from workflows.records.training_subjects import (
    Registered,
    has_truths,
    held_out,
    registered_meshes,
    true_meshes,
    write_held_out,
)
from workflows.steps import subject
from workflows.steps.evaluate import evaluate_models
from workflows.steps.stabilize import stabilize_run

STEP = "step.json"  # beside a product: the hash of what it was made from, and what the step told
MODEL, PAGE, PEOPLE = "gnm_head.npz", "index.html", "people.npz"
Told = dict[str, Any]  # JSON values


def builder(categories: Mapping[str, str] | None = None) -> Build:
    """The builder's settings: here, and nowhere else. What they are worth: docs/model_building.md."""
    return Build(identity=Identity(previous=None, by_area=True, share=0.999), categories=categories)


def register_subject(
    *,
    subject_dir: str,
    model: str,
    out: str,
    recipe: str = "draft",
    views: int | None = None,
    seed: int = 0,
    leave: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> Told:
    """A subject's captures -> the folder that `gnmreg subject` writes. What ended in an error is tried anew each time,
    but for the captures of `leave`, which tells why.

    Raises InputError as `subject.register_subject`.
    """
    captures = read_captures(Path(subject_dir))
    data = gnm_npz.read(Path(model))
    schemes = schemes_beside(Path(model), len(data.template_vertex_positions))
    inputs = {f"capture {capture.root.name}": hashing.hash_capture(capture) for capture in captures.captures}
    inputs |= {f"capture {name}": error.line for name, error in captures.broken.items()}
    inputs |= {f"landmarks {name}": hashing.content_of(one.indices, one.weights) for name, one in schemes.items()}
    inputs |= {"subject": captures.subject, "model": gnm_npz.content_hash(data)}
    wanted = hashing.input_hash(inputs, {"recipe": hashing.plain(recipe_named(recipe)), "views": views, "seed": seed})
    place = Path(out)
    if (known := _known(place, wanted)) is not None and _contents(place, known["contents"]) == known["contents"]:
        return {**known, "out": out}
    found = subject.register_subject(
        Path(subject_dir),
        model_path=Path(model),
        out=place,
        recipe=recipe,
        views=views,
        seed=seed,
        leave=leave,
        progress=progress,
    )
    rows = {row.name: {"status": row.status, "reason": row.reason, "usable": row.usable} for row in found.rows}
    contents = _contents(place, [row.name for row in found.rows if row.folder])
    told = {"out": out, "rows": rows, "contents": contents, "seconds": sum(row.seconds or 0 for row in found.rows)}
    if all(row.folder or row.status == "skipped" for row in found.rows):
        swap_in(place / STEP, _text({"input_hash": wanted, **told}))
    return {"input_hash": wanted, **told}


def hold_out(
    *, dataset: str, names: Sequence[str], registrations: str, model: str, out: str, progress: Progress | None = None
) -> Told:
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
    if (known := _known(place, wanted)) is not None and (place / PEOPLE).is_file():
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
    swap_in(place / STEP, _text(told))
    return told


def stabilize(*, run: str, names: Sequence[str], model: str, out: str, progress: Progress | None = None) -> Told:
    """A run's registrations -> the stabilized set `out`; none (`"out": null`) where there is too little to stabilize.

    Raises InputError as `stabilize_run`.
    """
    usable = {name: one for name in names if (one := read_usable(Path(run) / name)) is not None and one.expressions}
    count = sum(len(one.expressions) for one in usable.values())
    if count < LEAST_SAMPLES:
        return {"out": None, "reason": f"{count} expressions of {len(names)} subjects"}
    outcome = stabilize_run(
        Path(run), model_path=Path(model), out=Path(out), skip_failed=True, only=tuple(usable), progress=progress
    )
    manifest = stabilized.read_manifest(outcome.out)
    told = {name: manifest[name] for name in ("content_id", "input_hash")}
    return {"out": out, **told, "figures": hashing.plain(outcome.figures)}


def build(
    *,
    run: str,
    names: Sequence[str],
    steady: str | None,
    dataset: str,
    previous: str,
    out: str,
    progress: Progress | None = None,
) -> Told:
    """Registrations, stabilized expressions (`steady`) and the previous model -> the folder of the next model.

    Raises InputError as `coregister.next_model.build.build`.
    """
    found, data = read_dataset(Path(dataset)), gnm_npz.read(Path(previous))
    tags = {name: found.tags(name) for name in names}
    place = None if steady is None else Path(steady)
    subjects = Registered(run=Path(run), names=names, model=data, steady=place, tags=tags)
    settings = builder(found.categories)
    inputs = {**subjects.inputs, "previous": gnm_npz.content_hash(data)}
    wanted = hashing.input_hash(inputs, {"settings": hashing.plain(settings), "tags": tags})
    known = _known(Path(out), wanted)
    if known is not None and _is_model(Path(out) / MODEL, known["content_id"]):
        return {**known, "model": str(Path(out) / MODEL)}
    (progress or Silent()).note(f"building a model from {len(subjects.usable)} subjects")
    built = build_model(subjects, data, settings)
    told = {
        "input_hash": wanted,
        "model": str(Path(out) / MODEL),
        "content_id": built.manifest["content_id"],
        "registered": sum(1 + one["expressions"] for one in built.manifest["subjects"]),
        "rejected": built.manifest["rejected"],
        "components": built.manifest["identity"]["components"],
        "drift_mm": built.manifest["figures"]["drift_mm"],
    }
    with fresh_folder(Path(out)) as fresh:
        provenance.write(built.data, built.manifest, built.coefficients, fresh / MODEL, Path(previous))
        (fresh / PAGE).write_text(write_model_page(built.data, built.manifest), encoding="utf-8")
        (fresh / STEP).write_text(_text(told), encoding="utf-8")
    return told


def evaluate(
    *,
    models: Mapping[str, str],
    people: str,
    out: str,
    components: Sequence[int],
    samples: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> Told:
    """Models by name, the first one first, and held-out people -> the folder of `gnmreg model evaluate`.

    Figures are told with the numbers of `components` that all models have; "at" is the largest of them.
    Raises InputError as `evaluate_models`.
    """
    have = min(len(identity_part(gnm_npz.read(Path(path))).basis) for path in models.values())
    counts = tuple(k for k in components if k <= have) or (have,)
    paths = {name: Path(path) for name, path in models.items()}
    settings = Settings(components=counts, samples=samples, seed=seed)
    manifest = evaluate_models(paths, held_out=Path(people), out=Path(out), settings=settings, progress=progress)
    told: Told = {"out": out, "input_hash": manifest["input_hash"], "components": list(counts), "at": counts[-1]}
    for figure, curve in (("generalization_mm", "identity"), ("specificity_mm", "specificity")):
        curves = {name: one[curve] for name, one in manifest["figures"]["models"].items()}
        told[figure] = {
            name: dict(zip(map(str, one["components"]), (i["mean"] for i in one["intervals"]), strict=True))
            for name, one in curves.items()
            if one is not None
        }
    return told


def decide(
    *,
    first_mm: float,
    rounds: Sequence[Mapping[str, Any]],
    rule: Mapping[str, Any],
    progress: Progress | None = None,
) -> Told:
    """Rounds so far -> whether to go on, and why. Nothing is kept: it takes no time."""
    given = [deciding.Round(**one) for one in rounds]
    return vars(deciding.decide(first_mm, given, deciding.Rule(**rule)))


def _sources(found: Dataset, registrations: Path, name: str, true: bool) -> dict[str, str]:
    """Digests of what a held-out subject is read from."""
    if true:
        truths = [(c.root.name, c.expression, c.ground_truth) for c in found.subjects[name].captures]
        return {f"{folder} {label}": hashing.hash_file(file) for folder, label, file in truths if file is not None}
    one = read_usable(registrations / name)
    folders = () if one is None else (one.neutral, *one.expressions)
    return {folder: str(read_manifest(registrations / name / folder)["content_id"]) for folder in folders}


def _contents(place: Path, names: Sequence[str] | Mapping[str, str]) -> dict[str, str]:
    """Content ids of the registrations of these names that are there."""
    found = {}
    for name in names:
        try:
            found[name] = str(read_manifest(place / name)["content_id"])
        except InputError:
            continue
    return found


def _is_model(file: Path, content: str) -> bool:
    try:
        return gnm_npz.content_hash(gnm_npz.read(file)) == content
    except InputError:
        return False


def _known(place: Path, wanted: str) -> Told | None:
    """What a step told when it made the product in `place`, which may have lain elsewhere, from the same inputs."""
    try:
        told = json.loads((place / STEP).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return told if isinstance(told, dict) and told.get("input_hash") == wanted else None


def _text(value: Any) -> str:
    return json.dumps(hashing.plain(value), indent=1, allow_nan=False) + "\n"
