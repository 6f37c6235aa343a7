"""`gnmreg model compare`: the paper's evaluation protocol on registered scans, for models of any topology."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coregister.evaluate.confidence_intervals import Interval, bootstrap_interval
from coregister.evaluate.face_data import ComparedModel, FaceReference, FaceSample, compared, compared_gnm
from coregister.evaluate.face_model import IDENTITY
from coregister.evaluate.face_numbers import FaceComparison
from coregister.evaluate.face_protocol import (
    CODE,
    NEUTRAL,
    STAGES,
    ProtocolSettings,
    SampleResult,
    SampleTasks,
    curve_counts,
    evaluate_sample,
    planned_tasks,
)
from coregister.evaluate.face_tables import FaceTables, compactness_mm
from coregister.evaluate.linear_fit import LinearPart
from coregister.evaluate.specificity import specificity_mm
from registration.errors import InputError, check_seed
from registration.linear_models import registry
from registration.linear_models.options import ReadOptions
from registration.model import gnm_npz
from registration.model.gnm_npz import topology_hash
from registration.progress import NullProgress, Progress
from registration.storage.files import atomic_write_text, refuse_foreign
from registration.storage.hashing import input_hash, to_jsonable, versions
from registration.storage.records import Record
from registration.topology_map import file as map_file
from registration.topology_map.topology_map import TopologyMap
from workflows.pages.comparison import render_comparison_page
from workflows.processes import run_parallel
from workflows.records.face_results import read_result, write_result
from workflows.records.face_samples import FaceSampleSet, read_samples

MANIFEST, PAGE, NUMBERS, RESULTS = "manifest.json", "index.html", "numbers.csv", "samples"
_FILES = (MANIFEST, PAGE, NUMBERS, RESULTS)
_LEAST_DATABASE = 2  # neutrals that specificity needs


@dataclass(frozen=True, kw_only=True)
class ComparisonManifest(
    Record,
    kind="gnm-model-comparison",
    title="comparison's manifest",
    fix="compare again into another folder, or delete this one",
):
    """The record of a comparison of models: `manifest.json`."""

    finished: bool  # else only some of the samples were computed; the same command resumes
    figures: Mapping[str, Any]  # the table
    config: Mapping[str, Any]  # the settings
    inputs: Mapping[str, str]  # model or sample -> sha256
    versions: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class ComparisonInput:
    """What is compared, as files."""

    models: tuple[Path, ...]  # the first is a GNM model of the registered meshes' topology
    samples: Path
    captures: Path | None = None
    maps: tuple[Path, ...] = ()  # from the first model's topology to the others'
    without_jaw: tuple[Path, ...] = ()  # models that are compared without their jaw joint, besides `models`


@dataclass(frozen=True, kw_only=True, eq=False)
class _Loaded:
    models: Mapping[str, ComparedModel]
    reference: FaceReference
    samples: FaceSampleSet


def compare_models(
    given: ComparisonInput,
    *,
    out: Path,
    settings: ProtocolSettings | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> FaceComparison:
    """Compare models on registered scans and write the folder `out` (docs/formats.md).

    Args:
        given: models, samples, maps.
        out: folder of the comparison; samples whose result is there are not computed again.
        settings: of the protocol.
        jobs: number of processes.
        progress: where to report to.

    Raises:
        InputError: a file cannot be read; a model has another topology and there is no map to it; the folder is another
            command's; a sample has no scan of the face.
    """
    settings, progress, out = settings or ProtocolSettings(), progress or NullProgress(), Path(out)
    check_seed(settings.seed)
    refuse_foreign(out, kind=ComparisonManifest.KIND, command="model compare", files=_FILES)
    loaded = _load(given)
    for name, model in loaded.models.items():
        if isinstance(model.carried, TopologyMap) and not model.carried.accepted:
            progress.message(f"warning: the map to {name} was refused: {'; '.join(model.carried.reasons)}")
    manifest = ComparisonManifest(
        finished=False,
        figures={},
        config=to_jsonable(settings),
        inputs={name: model.face.content for name, model in loaded.models.items()}
        | {f"sample {s.name}": s.content() for s in loaded.samples.samples},
        versions=versions(),
    )
    (out / RESULTS).mkdir(parents=True, exist_ok=True)
    manifest.write(out / MANIFEST)
    if jobs > 1:
        call = {"given": given, "out": out, "settings": settings, "jobs": jobs}
        calls = {f"share {number}": {**call, "share": number} for number in range(jobs)}
        failures = [f"{name}: {reason}" for name, reason in run_parallel(compute_share, calls, jobs) if reason]
        if failures:
            fix = "run the command again: it resumes"
            raise InputError("Samples failed", where=out, expected="results of all", got="; ".join(failures), fix=fix)
    results = _compute(loaded, out, settings, progress)
    comparison = _summarize(loaded, results, settings, progress)
    atomic_write_text(out / NUMBERS, comparison.csv())
    manifest = replace(manifest, finished=True, figures=to_jsonable({"rows": comparison.rows}))
    page = render_comparison_page(comparison, loaded.reference, manifest.to_json(), settings)
    atomic_write_text(out / PAGE, page)
    manifest.write(out / MANIFEST)
    return comparison


def compute_share(*, given: ComparisonInput, out: Path, settings: ProtocolSettings, jobs: int, share: int) -> str:
    """Compute every `jobs`-th sample, in a process of its own; return the reason of a failure, "" for none."""
    try:
        _compute(_load(given), out, settings, NullProgress(), slice(share, None, jobs))
    except InputError as error:
        return str(error)
    return ""


def lines(comparison: FaceComparison) -> list[str]:
    """Return lines for a terminal: mean, median, standard deviation of every model and stage."""
    text = []
    for row in comparison.rows:
        if row.kind == "face":
            span = "" if row.mean.low is None else f" ({row.mean.low:.3f} to {row.mean.high:.3f})"
            figures = f"mean {row.mean.mean:.3f}{span} median {row.median:.3f} std {row.std:.3f} mm"
            text.append(f"{row.model}, {row.stage}: {figures}, {row.samples} samples")
    for item in comparison.agreements:
        ratio = f"Adam / least squares {item.ratio.mean:.3f}"
        text.append(f"{item.model}, {item.stage}: {ratio} on {item.samples} samples, {item.settled} settled")
    return text


def _load(given: ComparisonInput) -> _Loaded:
    first = gnm_npz.read(given.models[0])
    samples = read_samples(given.samples, given.captures)
    topology = topology_hash(first.triangles)
    if topology_hash(samples.triangles) != topology:
        raise InputError(
            "The registered meshes have another topology than the first model",
            where=given.samples,
            expected=f"{len(first.triangles)} triangles, those of {given.models[0]}",
            got=f"{len(samples.triangles)} triangles, or another order",
            fix="give the model first that has the topology of the registrations",
        )
    reference = FaceReference.of_model(first)
    maps = {path: map_file.read(path) for path in given.maps}
    models: dict[str, ComparedModel] = {}
    compared_files = [(path, ReadOptions()) for path in given.models]
    compared_files += [(path, ReadOptions(without_jaw=True)) for path in given.without_jaw]
    for path, options in compared_files:
        jaw = " without jaw" if options.without_jaw else ""
        name = f"{path.stem}{jaw}" if f"{path.stem}{jaw}" not in models else f"{path}{jaw}"
        models[name] = _read_model(path, options, name, reference, topology, maps)
    return _Loaded(models=models, reference=reference, samples=samples)


def _read_model(
    path: Path,
    options: ReadOptions,
    name: str,
    reference: FaceReference,
    topology: str,
    maps: Mapping[Path, TopologyMap],
) -> ComparedModel:
    data = registry.read(path, options)
    own = topology_hash(data.triangles)
    carried = None
    if own != topology:
        both = [m for m in maps.values() if {m.source_topology, m.target_topology} == {own, topology}]
        if not both:
            raise InputError(
                "There is no map to the model's topology",
                where=path,
                expected="a map from the first model's topology to this one's",
                got=f"{len(maps)} maps of others" if maps else "no map",
                fix="make one with `gnmreg model map`, and give it with --maps",
            )
        carried = both[0] if both[0].source_topology == topology else both[0].inverse()
    if data.format == "gnm":
        return compared_gnm(name, gnm_npz.read(path), reference, carried)
    return compared(name, data, reference, carried)


def _compute(
    loaded: _Loaded, out: Path, settings: ProtocolSettings, progress: Progress, share: slice = slice(None)
) -> dict[str, list[SampleResult]]:
    """Read the results of some samples, or compute and write them."""
    samples = list(loaded.samples.samples)
    plan = list(zip(range(len(samples)), samples, planned_tasks(samples, settings), strict=True))[share]
    results: dict[str, list[SampleResult]] = {name: [] for name in loaded.models}
    for done, (number, sample, tasks) in enumerate(plan):
        for place, (name, model) in enumerate(loaded.models.items()):
            progress.update(done, len(plan), f"{sample.name}, {name}")
            key = _key(sample, model, settings, tasks)
            file = out / RESULTS / f"{place}_{number:05d}.npz"
            result = read_result(file, key)
            if result is None:
                result = evaluate_sample(sample, model, loaded.reference, settings, tasks)
                write_result(result, key, file)
            results[name].append(result)
    return results


def _key(sample: FaceSample, model: ComparedModel, settings: ProtocolSettings, tasks: SampleTasks) -> str:
    """The digest of all that determines the result of a sample."""
    carried = model.target(np.arange(3 * len(sample.vertices), dtype=np.float64).reshape(-1, 3))
    inputs = {"sample": sample.content(), "model": model.face.content, "map": f"{carried.sum():.6g}"}
    used = {"points": settings.points, "components": settings.components, "seed": settings.seed, "adam": settings.adam}
    return input_hash(inputs, to_jsonable({**used, "tasks": tasks, "category": sample.category, "code": CODE}))


def _summarize(
    loaded: _Loaded, results: Mapping[str, Sequence[SampleResult]], settings: ProtocolSettings, progress: Progress
) -> FaceComparison:
    samples = loaded.samples.samples
    tables = {n: FaceTables(n, samples, r, loaded.reference, settings) for n, r in results.items()}
    every = [result for own in results.values() for result in own]
    left_out = [r.left_out / (r.left_out + 2 * len(r.nearest)) for r in every]
    return FaceComparison(
        models=tuple(loaded.models),
        samples=len(samples),
        subjects=len({sample.subject for sample in samples}),
        rows=tuple(row for table in tables.values() for row in table.rows()),
        agreements=tuple(item for table in tables.values() for item in table.agreements()),
        curves=tuple(c for name, table in tables.items() for c in table.curves(loaded.models[name].face)),
        densities=tuple(density for table in tables.values() for density in table.density()),
        compactness_mm={name: compactness_mm(model.face) for name, model in loaded.models.items()},
        specificity_mm={
            name: _specificity(model, samples, settings, progress) for name, model in loaded.models.items()
        },
        vertex_mm={name: table.vertex_mm() for name, table in tables.items()},
        unconverged={n: sum(not r.converged[s] for r in own for s in STAGES) for n, own in results.items()},
        left_out=float(np.mean(left_out)),
        largest={name: max(r.largest for r in own) for name, own in results.items()},
    )


def _specificity(
    model: ComparedModel, samples: Sequence[FaceSample], settings: ProtocolSettings, progress: Progress
) -> list[tuple[int, Interval]]:
    """Mean distance of random neutrals from the nearest real one, on the face; empty with fewer than two neutrals."""
    face = model.face
    neutrals = [model.target(sample.vertices) for sample in samples if sample.category == NEUTRAL]
    if not settings.random_heads or len(neutrals) < _LEAST_DATABASE:
        return []
    progress.message(f"{face.name}: {settings.random_heads} random heads")
    part = LinearPart(
        rows=face.rows, rest=face.rest, basis=face.basis[face.components[IDENTITY]], triangles=face.triangles
    )
    counts = curve_counts(face, IDENTITY, settings.components)
    values = specificity_mm(part, np.stack(neutrals), counts, samples=settings.random_heads, seed=settings.seed)
    intervals = [bootstrap_interval(column, seed=settings.seed, draws=settings.draws) for column in values.T]
    return list(zip(counts, intervals, strict=True))
