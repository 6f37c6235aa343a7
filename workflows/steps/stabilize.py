"""`gnmreg stabilize`, also as a step: both stages over a run's registrations, with one subject in memory at a time."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.progress import NullProgress, Progress
from registration.stabilize import stabilized_folder as disk
from registration.stabilize.components import MIN_SAMPLES, HeadGeometry, RegionalComponents
from registration.stabilize.decisions import CorrectionEffect, Decision, correction_effect
from registration.stabilize.pipeline import (
    Displacements,
    Stabilization,
    StabilizedSubject,
    apply_corrections,
    automatic_stage,
    regional_stage,
)
from registration.stabilize.stabilized_folder import StoredComponents
from registration.storage.hashing import input_hash, to_jsonable, versions
from workflows.pages.stabilization import render_stabilization_page
from workflows.records.decisions import read_decisions
from workflows.records.run import STABILIZED, Selection, StabilizationInputs, read_run
from workflows.records.step_results import StabilizeResult
from workflows.records.subject import read_usable_subjects
from workflows.steps.coregistration_page import shown_on_page
from workflows.steps.gate import read_gate

LOG = "decisions.jsonl"  # within the run
Reuse = Literal["same inputs", "any decisions", "none"]


@dataclass(frozen=True, kw_only=True)
class StabilizationResult:
    """The stabilized set of a run."""

    out: Path
    dataset: str  # id of registrations, model and settings, which decisions refer to
    figures: dict[str, Any]


def stabilize_run(
    run: Path,
    *,
    model_path: Path,
    out: Path | None = None,
    decisions: Path | None = None,
    settings: Stabilization | None = None,
    selection: Selection = Selection(),  # noqa: B008  frozen
    reuse: Reuse = "same inputs",
    progress: Progress | None = None,
) -> StabilizationResult:
    """Stabilize all registrations of a run and write the stabilized set (docs/formats.md).

    Args:
        run: a folder of subject folders, or one subject folder.
        model_path: the model that the captures were registered with.
        out: folder of the stabilized set; None: RUN/stabilized. A set of the same inputs is kept.
        decisions: log of decisions about components; None: none.
        settings: of both stages.
        selection: of subject folders and registrations.
        reuse: which existing set is returned: of the same inputs; also of other decisions, since its components are the
            same; or none.
        progress: where to report to.

    Raises:
        InputError: as `read_run`, `read_decisions`, `check_output_folder`; fewer than two expressions. Nothing is
            written then.
    """
    progress, settings = progress or NullProgress(), settings or Stabilization()
    out = Path(run) / STABILIZED if out is None else Path(out)
    data = gnm_npz.read(model_path)
    head = HeadGeometry.from_model(data)
    inputs = read_run(run, data, selection)
    disk.check_output_folder(out)
    _check_count(inputs, run)
    dataset = input_hash(inputs.inputs, to_jsonable(settings))
    decided = [] if decisions is None else read_decisions(decisions, dataset)
    digest = input_hash(inputs.inputs, {"settings": to_jsonable(settings), "decisions": to_jsonable(decided)})
    if reuse != "none" and disk.is_stabilized(out):
        manifest = disk.read_manifest(out)
        if manifest.input_hash == digest or (reuse == "any decisions" and manifest.dataset == dataset):
            return StabilizationResult(out=out, dataset=dataset, figures=dict(manifest.figures))
    with disk.new_stabilized_set(out) as temporary:
        ids, components, effect = _write_subjects(temporary, inputs, data, head, settings, decided, progress)
        figures = _figures(components, effect, temporary, len(inputs.subjects))
        manifest = disk.StabilizedManifest(
            content_id=input_hash(ids, {}),
            input_hash=digest,
            dataset=dataset,
            subjects=tuple(subject.subject for subject in inputs.subjects),
            left_out={subject.subject: tuple(subject.excluded) for subject in inputs.subjects if subject.excluded},
            decisions=tuple(to_jsonable(decided)),
            figures=figures,
            config=to_jsonable(settings),
            inputs=inputs.inputs,
            versions=versions(),
        )
        manifest.write(temporary / disk.MANIFEST)
        stabilized = (disk.read_subject(temporary, k) for k in range(len(inputs.subjects)))
        page = render_stabilization_page(manifest, components, stabilized, head)
        (temporary / disk.PAGE).write_text(page, encoding="utf-8")
    return StabilizationResult(out=out, dataset=dataset, figures=figures)


@shown_on_page()
def stabilize_subjects(
    *,
    run: str,
    names: Sequence[str],
    model: str,
    out: str,
    gate: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Stabilize the usable registrations of a run into the set `out`, if there are enough expressions.

    Args:
        run: folder of the subject folders.
        names: of the subject folders to use.
        model: file of the model that the captures were registered with.
        out: folder of the stabilized set.
        gate: folder of the gate's record; None: all usable registrations are used.
        progress: where to report to.

    Returns:
        A `StabilizeResult` as JSON; its `out` is null if there are too few expressions.

    Raises:
        InputError: as `stabilize_run`.
    """
    gated = read_gate(gate)
    left_out = frozenset(gated.left_out if gated else ())
    usable = read_usable_subjects(Path(run), names, left_out)
    counts = {name: len(subject.expressions) for name, subject in usable.items() if subject.expressions}
    total = sum(counts.values())
    if total < MIN_SAMPLES:
        return StabilizeResult(out=None, reason=f"{total} expressions of {len(names)} subjects").to_json()
    result = stabilize_run(
        Path(run),
        model_path=Path(model),
        out=Path(out),
        selection=Selection(skip_failed=True, only=tuple(counts), left_out=left_out),
        progress=progress,
    )
    manifest = disk.read_manifest(result.out)
    return StabilizeResult(
        out=out,
        content_id=manifest.content_id,
        input_hash=manifest.input_hash,
        figures=to_jsonable(result.figures),
    ).to_json()


def _write_subjects(
    folder: Path,
    run: StabilizationInputs,
    data: GNMData,
    head: HeadGeometry,
    settings: Stabilization,
    decisions: Sequence[Decision],
    progress: Progress,
) -> tuple[dict[str, str], list[RegionalComponents], CorrectionEffect]:
    """Compute both stages; return content ids by file, the components, and the effect of the second stage."""
    count = len(run.subjects)
    for number, meshes in enumerate(run.meshes()):
        progress.update(number, count, f"the skull of {meshes.subject}")
        disk.write_subject(automatic_stage(meshes, head, run.skin, settings), folder, number)

    def stabilized() -> Iterator[StabilizedSubject]:
        return (disk.read_subject(folder, k) for k in range(count))

    progress.update(count, count, "components of all subjects")
    components, corrections = regional_stage(stabilized, head, settings, decisions)
    names = [(s.subject, name, label) for s in stabilized() for name, label in zip(s.names, s.labels, strict=True)]
    subjects, files, labels = (tuple(row[k] for row in names) for k in range(3))
    mean_displacement = mean_displacements(Displacements(stabilized), components)
    stored = StoredComponents(
        components=tuple(components), subjects=subjects, names=files, labels=labels, mean_displacement=mean_displacement
    )
    ids = {disk.COMPONENTS: disk.write_components(stored, folder)}
    first_sample = 0
    for number in range(count):
        subject = disk.read_subject(folder, number)
        ids[f"{number:04d}"] = disk.write_subject(apply_corrections(subject, corrections, first_sample), folder, number)
        first_sample += len(subject.names)
    return ids, components, correction_effect(corrections, head)


def mean_displacements(
    displacements: Iterable[np.ndarray], components: Sequence[RegionalComponents]
) -> dict[str, np.ndarray]:
    """Return the head's mean displacement per unit coefficient, by region; coefficients have a mean square of one.

    Args:
        displacements: (V, 3) of each sample.
        components: of all regions, with coefficients of the same samples.
    """
    sums: dict[str, np.ndarray] = {}
    count = 0
    for count, displacement in enumerate(displacements, 1):
        for part in components:
            step = part.coefficients[count - 1][:, None, None] * displacement
            sums[part.region] = sums[part.region] + step if part.region in sums else step
    return {region: total / count for region, total in sums.items()}


def _figures(
    components: Sequence[RegionalComponents], effect: CorrectionEffect, folder: Path, count: int
) -> dict[str, Any]:
    residual = np.concatenate([disk.read_subject(folder, k).residual_mm for k in range(count)])
    return {
        "samples": len(residual),
        "residual_first_median_mm": float(np.median(residual[:, 0])),
        "residual_median_mm": float(np.median(residual[:, -1])),
        "residual_p95_mm": float(np.percentile(residual[:, -1], 95)),
        "components": {part.region: len(part.energy) for part in components},
        "flagged": {part.region: np.flatnonzero(part.flagged).tolist() for part in components},
        "regional_rms_mm": effect.rms_mm,
        "regional_most_mm": effect.max_mm,
        "regional_turn_deg": effect.rotation_deg,
    }


def _check_count(run: StabilizationInputs, where: Path) -> None:
    count = sum(len(subject.expressions) for subject in run.subjects)
    if count < MIN_SAMPLES:
        raise InputError(
            "There is only one expression to stabilize",
            where=where,
            expected=f"at least {MIN_SAMPLES} expressions of all subjects together",
            got=count,
            fix="register more expressions; `stabilize_subject` alone aligns a single one",
        )
