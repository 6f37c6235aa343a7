"""`gnmreg model evaluate`, also as a step: models and held-out subjects in, a folder with figures and a page out."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coregister.evaluate.evaluation import EvaluationSettings, ModelEvaluation, check, evaluate
from coregister.evaluate.linear_fit import identity_part
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.progress import Progress
from registration.storage.files import atomic_directory, read_json_of_kind, refuse_foreign
from registration.storage.hashing import input_hash, to_jsonable, versions
from workflows.pages.evaluation import write_evaluate_page
from workflows.records.held_out import read_held_out
from workflows.records.step_results import EvaluateResult

SCHEMA = 1
KIND = "gnm-evaluation"
MANIFEST, PAGE, VERTICES = "manifest.json", "index.html", "vertices.npz"
_FILES = (MANIFEST, PAGE, VERTICES)


def evaluate_models(
    model_paths: Sequence[Path] | Mapping[str, Path],
    *,
    held_out: Path,
    out: Path,
    captures: Path | None = None,
    settings: EvaluationSettings | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Evaluate model files on held-out subjects and write the folder `out` (docs/formats.md); returns its manifest.

    A folder made from the same inputs is left as it is, unless `force`. Others are compared with the first model.
    Models are named as in the mapping, or after their files.

    Raises:
        InputError: as `read_held_out`, `evaluation.check` and `check_out`, before anything is computed.
    """
    settings = settings or EvaluationSettings()
    check_out(out)
    named = model_paths if isinstance(model_paths, Mapping) else _named(model_paths)
    models = {name: gnm_npz.read(path) for name, path in named.items()}
    found = read_held_out(held_out, captures)
    check(models, found.subjects, found.triangles, settings)
    inputs = {**{f"model {name}": gnm_npz.content_hash(data) for name, data in models.items()}, **found.inputs}
    wanted = input_hash(inputs, to_jsonable(settings))
    known = None if force else read_json_of_kind(Path(out) / MANIFEST, KIND)
    if known is not None and known.get("input_hash") == wanted and known.get("schema") == SCHEMA:
        return known
    evaluation = evaluate(models, found.subjects, found.triangles, settings, progress)
    manifest: dict[str, Any] = to_jsonable(
        {
            "kind": KIND,
            "schema": SCHEMA,
            "input_hash": wanted,
            "figures": evaluation.metrics,
            "config": settings,
            "inputs": inputs,
            "versions": versions(),
        }
    )
    _write(manifest, evaluation, models, Path(out))
    return manifest


def evaluate_round(
    *,
    models: Mapping[str, str],
    people: str,
    out: str,
    components: Sequence[int],
    samples: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Evaluate all models of a coregistration so far; the folder is that of `gnmreg model evaluate`.

    Args:
        models: name -> file, the first model first.
        people: file of the held-out subjects.
        out: folder of the evaluation.
        components: requested numbers of components; those that a model does not have are omitted.
        samples: random heads of each model, for specificity.
        seed: of the random heads.
        progress: where to report to.

    Returns:
        An `EvaluateResult` as JSON.

    Raises:
        InputError: as `evaluate_models`.
    """
    available = min(len(identity_part(gnm_npz.read(Path(path))).basis) for path in models.values())
    counts = tuple(k for k in components if k <= available) or (available,)
    paths = {name: Path(path) for name, path in models.items()}
    settings = EvaluationSettings(components=counts, samples=samples, seed=seed)
    manifest = evaluate_models(paths, held_out=Path(people), out=Path(out), settings=settings, progress=progress)
    figures = manifest["figures"]["models"]
    return EvaluateResult(
        input_hash=manifest["input_hash"],
        out=out,
        components=counts,
        at=counts[-1],
        generalization_mm=_means(figures, "identity"),
        specificity_mm=_means(figures, "specificity"),
    ).to_json()


def _means(figures: Mapping[str, Any], curve: str) -> dict[str, dict[str, float | None]]:
    """Model -> number of components -> mean of a curve, for the models that have it."""
    curves = {name: model[curve] for name, model in figures.items() if model[curve] is not None}
    return {
        name: dict(zip(map(str, c["components"]), (i["mean"] for i in c["intervals"]), strict=True))
        for name, c in curves.items()
    }


def lines(manifest: Mapping[str, Any]) -> list[str]:
    """The figures for a terminal: a line each model and number of components, then what models gain on the first."""
    figures, found = manifest["figures"], []
    for name, one in figures["models"].items():
        rows = zip(one["identity"]["components"], one["identity"]["intervals"], strict=True)
        for number, (count, distance) in enumerate(rows):
            random = one["specificity"] and one["specificity"]["intervals"][number]["mean"]
            told = f", specificity {random:.3f} mm" if random is not None else ""
            span = f"{distance['low']:.3f} to {distance['high']:.3f}"
            found.append(f"{name}, {count} components: generalization {distance['mean']:.3f} mm ({span}){told}")
    for gain in figures["gains"]:
        share = gain["gain"]
        span = f"{100 * share['low']:.1f} to {100 * share['high']:.1f}"
        found.append(f"{gain['model']}, {gain['components']} components: gain {100 * share['mean']:.1f} % ({span})")
    return found


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that is not ours to replace. Raises InputError."""
    refuse_foreign(Path(out), kind=KIND, command="model evaluate", files=_FILES)


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """By the files' names without suffix, or by their paths where these are equal."""
    stems = [Path(path).stem for path in paths]
    named = {stem if stems.count(stem) == 1 else str(path): Path(path) for stem, path in zip(stems, paths, strict=True)}
    if len(named) < len(paths):
        raise InputError(
            "A model comes twice",
            where="models",
            expected="different files",
            got=", ".join(str(path) for path in paths),
            fix="give each once",
        )
    return named


def _write(manifest: Mapping[str, Any], evaluation: ModelEvaluation, models: Mapping[str, GNMData], out: Path) -> None:
    """The folder appears, or is replaced, in one rename."""
    with atomic_directory(out) as fresh:
        (fresh / MANIFEST).write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        distances = {name: one.vertex_mm.astype(np.float32) for name, one in evaluation.models.items()}
        np.savez(
            fresh / VERTICES,
            allow_pickle=False,
            models=np.array(list(distances)),
            distance_mm=np.stack(list(distances.values())),
        )
        (fresh / PAGE).write_text(write_evaluate_page(evaluation, models, manifest), encoding="utf-8")
