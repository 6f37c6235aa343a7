"""`gnmreg model evaluate`, also as a step: writes a folder with metrics and a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coregister.evaluate.evaluation import EvaluationSettings, ModelEvaluation, check, evaluate
from coregister.evaluate.linear_fit import identity_part
from registration.errors import InputError, check_seed
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.progress import NullProgress, Progress
from registration.storage.files import atomic_directory, refuse_foreign
from registration.storage.hashing import input_hash, to_jsonable, versions
from registration.storage.records import Record
from workflows.pages.evaluation import render_evaluation_page
from workflows.records.held_out import read_held_out
from workflows.records.step_results import EvaluateResult
from workflows.steps.coregistration_page import shown_on_page

MANIFEST, PAGE, VERTICES = "manifest.json", "index.html", "vertices.npz"
_FILES = (MANIFEST, PAGE, VERTICES)


@dataclass(frozen=True, kw_only=True)
class EvaluationManifest(
    Record,
    kind="gnm-evaluation",
    title="evaluation's manifest",
    fix="evaluate again with --force, or delete the folder",
):
    """The record of an evaluation of models: `manifest.json`."""

    input_hash: str  # of everything that determines the evaluation
    figures: Mapping[str, Any]
    config: Mapping[str, Any]  # the settings
    inputs: Mapping[str, str]  # input -> sha256
    versions: Mapping[str, str]

    @classmethod
    def from_json(cls, value: Any, *, where: object) -> "EvaluationManifest":
        """Read a manifest from a JSON value. Raises InputError as `Record.read`, and for other figures than ours."""
        manifest = super().from_json(value, where=where)
        try:
            lines(manifest)
            _means(manifest.figures["models"], "identity")
        except (AttributeError, KeyError, IndexError, TypeError, ValueError):
            expected = "figures as `gnmreg model evaluate` writes them"
            raise cls.invalid(f"{where}, field 'figures'", expected=expected, got="others") from None
        return manifest


def evaluate_models(
    model_paths: Sequence[Path] | Mapping[str, Path],
    *,
    held_out: Path,
    out: Path,
    captures: Path | None = None,
    settings: EvaluationSettings | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> EvaluationManifest:
    """Evaluate model files on held-out subjects, write the folder `out` (docs/formats.md) and return its manifest.

    Args:
        model_paths: name -> file, or files, which are named by their stems. All are compared with the first.
        held_out: as for `read_held_out`.
        out: folder of the evaluation. An evaluation of the same inputs is kept.
        captures: as for `read_held_out`.
        settings: of the evaluation.
        force: compute again even if there is an evaluation of the same inputs.
        progress: where to report to.

    Raises:
        InputError: as `read_held_out`, `evaluation.check` and `check_out`, before anything is computed.
    """
    settings = settings or EvaluationSettings()
    check_seed(settings.seed)
    check_out(out)
    named = model_paths if isinstance(model_paths, Mapping) else _named(model_paths)
    models = {name: gnm_npz.read(path) for name, path in named.items()}
    subjects = read_held_out(held_out, captures)
    for warning in subjects.warnings:
        (progress or NullProgress()).message(f"warning: {warning}")
    check(models, subjects.subjects, subjects.triangles, settings)
    inputs = {**{f"model {name}": gnm_npz.content_hash(data) for name, data in models.items()}, **subjects.inputs}
    digest, file = input_hash(inputs, to_jsonable(settings)), Path(out) / MANIFEST
    existing = EvaluationManifest.read(file) if file.is_file() and not force else None
    if existing is not None and existing.input_hash == digest:
        return existing
    evaluation = evaluate(models, subjects.subjects, subjects.triangles, settings, progress)
    manifest = EvaluationManifest(
        input_hash=digest,
        figures=to_jsonable(evaluation.metrics),
        config=to_jsonable(settings),
        inputs=inputs,
        versions=versions(),
    )
    _write(manifest, evaluation, models, Path(out))
    return manifest


@shown_on_page()
def evaluate_round(
    *,
    models: Mapping[str, str],
    held_out: str,
    out: str,
    components: Sequence[int],
    samples: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Evaluate all models of a coregistration so far; the folder is that of `gnmreg model evaluate`.

    Args:
        models: name -> file, the first model first.
        held_out: file of the held-out subjects.
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
    manifest = evaluate_models(paths, held_out=Path(held_out), out=Path(out), settings=settings, progress=progress)
    figures = manifest.figures["models"]
    return EvaluateResult(
        input_hash=manifest.input_hash,
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


def lines(manifest: EvaluationManifest) -> list[str]:
    """Return lines for a terminal: one per model and number of components, then the gains over the first model."""
    figures, text = manifest.figures, []
    for name, model in figures["models"].items():
        rows = zip(model["identity"]["components"], model["identity"]["intervals"], strict=True)
        for number, (count, distance) in enumerate(rows):
            random = model["specificity"] and model["specificity"]["intervals"][number]["mean"]
            suffix = f", specificity {random:.3f} mm" if random is not None else ""
            span = f"{distance['low']:.3f} to {distance['high']:.3f}"
            text.append(f"{name}, {count} components: generalization {distance['mean']:.3f} mm ({span}){suffix}")
    for gain in figures["gains"]:
        interval = gain["gain"]
        span = f"{100 * interval['low']:.1f} to {100 * interval['high']:.1f}"
        text.append(f"{gain['model']}, {gain['components']} components: gain {100 * interval['mean']:.1f} % ({span})")
    return text


def check_out(out: Path) -> None:
    """Refuse, before any work, an output folder that is not an evaluation's. Raises InputError."""
    refuse_foreign(Path(out), kind=EvaluationManifest.KIND, command="model evaluate", files=_FILES)


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """Files by their stems, or by their paths where stems are equal."""
    stems = [Path(path).stem for path in paths]
    named = {stem if stems.count(stem) == 1 else str(path): Path(path) for stem, path in zip(stems, paths, strict=True)}
    if len(named) < len(paths):
        raise InputError(
            "A model is given twice",
            where="models",
            expected="different files",
            got=", ".join(str(path) for path in paths),
            fix="give each file once",
        )
    return named


def _write(manifest: EvaluationManifest, evaluation: ModelEvaluation, models: Mapping[str, GNMData], out: Path) -> None:
    """Write or replace the folder in one rename."""
    with atomic_directory(out) as temporary:
        manifest.write(temporary / MANIFEST)
        distances = {name: model.vertex_mm.astype(np.float32) for name, model in evaluation.models.items()}
        np.savez(
            temporary / VERTICES,
            allow_pickle=False,
            models=np.array(list(distances)),
            distance_mm=np.stack(list(distances.values())),
        )
        (temporary / PAGE).write_text(render_evaluation_page(evaluation, models, manifest.to_json()), encoding="utf-8")
