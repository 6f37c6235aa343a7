"""`gnmreg sampler train` and `gnmreg sample`: a sampler trained from registrations, and heads drawn from it."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coregister.sampler import keras_decoder, pictures, storage
from coregister.sampler.decoder import PARTS, Part, Sampler
from coregister.sampler.metrics import measure
from coregister.sampler.networks import EXPRESSION_LAYERS, IDENTITY_LAYERS
from coregister.sampler.penetration import HeadMaker, training_depths_mm
from coregister.sampler.samples import CoefficientSet, coefficient_set, split_by_subject
from coregister.sampler.sampling import DrawnHead, DrawnHeads, SampleSettings, draw_heads
from coregister.sampler.storage import PartRecord, SamplerRecord
from coregister.sampler.training import TrainedNetwork, TrainingSettings, train
from registration.errors import InputError
from registration.model import gnm_npz
from registration.progress import PrefixedProgress, Progress
from registration.report.head_pictures import write_sheet
from registration.storage.files import atomic_directory, refuse_foreign
from registration.storage.hashing import hash_file, versions
from registration.storage.mesh import write_ply
from registration.storage.records import Record
from workflows.records.coefficients import Coefficients, read_coefficients
from workflows.records.subject import NEUTRAL

EXPRESSION = "expression"  # the factor of the expression network
AUDIT = "audit"  # its duration, in `SamplerRecord.seconds`
CURVES, SHEET, COEFFICIENTS, MANIFEST, MESHES = (
    *("training.png", "contact_sheet.png", "coefficients.npz", "manifest.json", "meshes"),
)
TRAIN_COMMAND, SAMPLE_COMMAND = "sampler train", "sample"
_SHEET_HEADS = 20
LAYERS: Mapping[Part, tuple[int, ...]] = {"identity": IDENTITY_LAYERS, "expression": EXPRESSION_LAYERS}


@dataclass(frozen=True, kw_only=True)
class SamplerInput:
    """What a sampler is trained on."""

    source: Path  # a run, or an NPZ file of coefficients
    captures: Path | None = None  # of the run's subjects
    factors: tuple[str, ...] = (
        "gender",
        "ethnicity",
    )  # tags of the identity; empty: no identities


@dataclass(frozen=True, kw_only=True)
class SampledHead:
    """A drawn head in `manifest.json`."""

    mesh: str
    categories: Mapping[str, Mapping[str, float]]
    depth_mm: float | None
    redrawn: int
    penetrates: bool


@dataclass(frozen=True, kw_only=True)
class SamplesRecord(
    Record, kind="gnm-samples", title="record of drawn heads", fix="run `gnmreg sample` again with another folder"
):
    """`manifest.json` of a folder of drawn heads."""

    heads: tuple[SampledHead, ...]
    wanted: Mapping[str, str]
    seed: int
    redrawn: int
    remarks: tuple[str, ...]
    inputs: Mapping[str, str]  # sampler and model -> digest
    versions: Mapping[str, str] = field(default_factory=versions)


def train_sampler(
    given: SamplerInput, model: Path, out: Path, settings: TrainingSettings, progress: Progress
) -> SamplerRecord:
    """Train a sampler and write its folder in one rename.

    Args:
        given: coefficients and tags.
        model: the head model that the coefficients belong to.
        out: the folder to write; one that this command wrote before is replaced.
        settings: of both trainings.
        progress: receives the steps.

    Raises:
        InputError: before anything is trained or written: input that cannot be read, too few samples for the
            categories, coefficients that do not fit the model, or a folder that is not ours.
    """
    settings.check()
    refuse_foreign(out, kind=SamplerRecord.KIND, command=TRAIN_COMMAND, manifest=storage.RECORD)
    data = gnm_npz.read(model)
    read = read_coefficients(given.source, given.captures, given.factors)
    content = gnm_npz.content_hash(data)
    _check_model(read, data, content, model)
    sets, remarks = coefficient_sets(read, given)
    networks, parts = dict[Part, TrainedNetwork](), dict[Part, PartRecord]()
    maker, depths = HeadMaker(data), dict[str, float]()
    seconds, cpu_seconds = dict[str, float](), dict[str, float]()
    for part, samples in sets.items():
        training, held_out = split_by_subject(samples, settings.seed)
        with _timed(part, seconds, cpu_seconds):
            networks[part] = train(training, held_out, LAYERS[part], settings, PrefixedProgress(progress, part))
        parts[part] = _part_record(networks[part], training, held_out, settings)
        if part == "expression":
            with _timed(AUDIT, seconds, cpu_seconds):
                depths = training_depths_mm(maker, training, settings.seed, progress)
    arrays = storage.arrays_of(networks)
    record = SamplerRecord(
        parts={str(part): found for part, found in parts.items()},
        content_id=storage.content_id(arrays),
        model=content,
        depth_mm=depths,
        inputs=read.inputs,
        remarks=(*read.remarks, *remarks),
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        threads=torch.get_num_threads(),
    )
    decoders = {part: networks[part].decoder(sets[part].factors) for part in networks}
    sampler = Sampler(decoders=decoders, model=content, depth_mm=depths)
    heads = draw_each_category(sampler, maker, settings.seed, progress)
    with atomic_directory(out) as temporary:
        pictures.write_curves(networks, {part: parts[part].metrics for part in networks}, temporary / CURVES)
        write_sheet(pictures.contact_sheet(maker, heads.heads, "drawn heads"), temporary / SHEET)
        storage.write_sampler(record, arrays, temporary)
    return record


@contextmanager
def _timed(name: str, seconds: dict[str, float], cpu_seconds: dict[str, float]) -> Iterator[None]:
    """Record how long the block takes, on the clock and of all cores together."""
    wall, cpu = time.perf_counter(), time.process_time()
    yield
    seconds[name] = round(time.perf_counter() - wall, 1)
    cpu_seconds[name] = round(time.process_time() - cpu, 1)


def sample(sampler_path: Path, model: Path, out: Path, settings: SampleSettings, progress: Progress) -> DrawnHeads:
    """Draw heads and write coefficients, meshes, a contact sheet and a manifest, in one rename.

    Args:
        sampler_path: a folder of `gnmreg sampler train`; or Google's decoders, a file or their folder.
        model: the head model.
        out: the folder to write; one that this command wrote before is replaced.
        settings: what to draw.
        progress: receives the heads.

    Raises:
        InputError: before anything is drawn or written: input that cannot be read or does not belong together,
            categories that the sampler lacks, or a folder that is not ours.
    """
    settings.check()
    refuse_foreign(out, kind=SamplesRecord.KIND, command=SAMPLE_COMMAND, manifest=MANIFEST)
    sampler, digest = open_sampler(sampler_path)
    data = gnm_npz.read(model)
    content = gnm_npz.content_hash(data)
    if sampler.model and sampler.model != content:
        raise _wrong_model(model, sampler.model, content)
    maker = HeadMaker(data)
    drawn = draw_heads(sampler, maker, settings, progress)
    names = [f"{number:04d}.ply" for number in range(len(drawn.heads))]
    with atomic_directory(out) as temporary:
        (temporary / MESHES).mkdir()
        for name, head in zip(names, drawn.heads, strict=True):
            write_ply(temporary / MESHES / name, maker.vertices(head.identity, head.expression), data.triangles)
        np.savez(
            temporary / COEFFICIENTS,
            allow_pickle=False,
            identity=np.stack([head.identity for head in drawn.heads]),
            expression=np.stack([head.expression for head in drawn.heads]),
        )
        heading = f"{len(drawn.heads)} heads, seed {settings.seed}"
        write_sheet(pictures.contact_sheet(maker, drawn.heads, heading), temporary / SHEET)
        SamplesRecord(
            heads=tuple(
                SampledHead(
                    mesh=f"{MESHES}/{name}",
                    categories=head.categories,
                    depth_mm=head.depth_mm,
                    redrawn=head.redrawn,
                    penetrates=head.penetrates,
                )
                for name, head in zip(names, drawn.heads, strict=True)
            ),
            wanted=settings.wanted,
            seed=settings.seed,
            redrawn=drawn.redrawn,
            remarks=drawn.remarks,
            inputs={"sampler": digest, "model": content},
        ).write(temporary / MANIFEST)
    return drawn


def open_sampler(path: Path) -> tuple[Sampler, str]:
    """Return a sampler and its digest: of a folder that we wrote, or of Google's decoders. Raises InputError."""
    if (path / storage.RECORD).exists() or (path.is_dir() and not _decoder_files(path)):
        sampler, record = storage.read_sampler(path)
        return sampler, record.content_id
    sampler = keras_decoder.read_decoders(path)
    return sampler, " ".join(hash_file(file) for file in _decoder_files(path) or [path])


def _decoder_files(path: Path) -> list[Path]:
    return [path / name for name in keras_decoder.FILES.values() if (path / name).is_file()]


def draw_each_category(sampler: Sampler, maker: HeadMaker, seed: int, progress: Progress) -> DrawnHeads:
    """Draw a head of each category of every factor's, at most `_SHEET_HEADS` expressions, without an audit."""
    expression = sampler.decoders.get("expression")
    names = expression.factors[0].categories[:_SHEET_HEADS] if expression else ("",) * 12
    heads = list[DrawnHead]()
    for number, name in enumerate(names):
        wanted = {EXPRESSION: name} if name else {}
        settings = SampleSettings(wanted=wanted, count=1, seed=seed + number, audit=False)
        heads += draw_heads(sampler, maker, settings, progress).heads
    return DrawnHeads(heads=tuple(heads), remarks=())


def coefficient_sets(read: Coefficients, given: SamplerInput) -> tuple[dict[Part, CoefficientSet], list[str]]:
    """Return what each network is trained on, and remarks.

    Args:
        read: coefficients and tags. Its identities are those of each subject once, its expressions all but the
            neutrals; identities without a tag are left out and counted.
        given: what they were read from.

    Raises:
        InputError: too few samples for the categories, or neither tags nor expressions.
    """
    sets, remarks = dict[Part, CoefficientSet](), list[str]()
    if given.factors:
        first = sorted({name: row for row, name in reversed(list(enumerate(read.subjects)))}.values())
        rows = [row for row in first if all(read.tags[name][row] for name in given.factors)]
        if not rows:
            have = [f"{name} of {sum(bool(read.tags[name][row]) for row in first)}" for name in given.factors]
            raise InputError(
                "No subject has all of the tags",
                where=given.source,
                expected=", ".join(given.factors),
                got=f"of {len(first)} subjects " + ", ".join(have),
                fix="add the tags to the neutrals' captures, or name those that they have with --factors",
            )
        if len(rows) < len(first):
            remarks.append(f"{len(first) - len(rows)} subjects without a tag are left out of the identities")
        names = [tuple(read.tags[name][row] for name in given.factors) for row in rows]
        sets["identity"] = _set(read.identity, read, rows, names, given.factors, given.source)
    rows = [row for row, label in enumerate(read.labels) if label != NEUTRAL]
    if rows:
        names = [(read.labels[row],) for row in rows]
        expressions = _set(read.expression, read, rows, names, (EXPRESSION,), given.source)
        sets["expression"] = replace(expressions, identities=read.identity[rows])
    else:
        remarks.append("there are no expressions: only identities can be drawn")
    if not sets:
        what, fix = "There is nothing to train on", "give registrations of expressions, or --factors"
        raise InputError(what, where=given.source, expected="tags or expressions", got="neither", fix=fix)
    return {part: sets[part] for part in PARTS if part in sets}, remarks


def _set(
    values: np.ndarray,
    read: Coefficients,
    rows: Sequence[int],
    names: Sequence[tuple[str, ...]],
    factors: Sequence[str],
    where: Path,
) -> CoefficientSet:
    return coefficient_set(values[list(rows)], names, factors, [read.subjects[row] for row in rows], where)


def _part_record(
    trained: TrainedNetwork, training: CoefficientSet, held_out: CoefficientSet, settings: TrainingSettings
) -> PartRecord:
    architecture = trained.network.architecture
    return PartRecord(
        coefficients=architecture.coefficients,
        layers=architecture.layers,
        latent=architecture.latent,
        factors=training.factors,
        scale=trained.scale,
        settings=settings,
        training_samples=len(training.subjects),
        held_out_samples=len(held_out.subjects),
        subjects=len(set(training.subjects)),
        counts={factor.name: training.counts(k) for k, factor in enumerate(training.factors)},
        metrics=measure(trained, training, held_out, settings.seed),
    )


def _check_model(read: Coefficients, data: gnm_npz.GNMData, content: str, file: Path) -> None:
    """Refuse a model that the coefficients do not belong to. Raises InputError."""
    if read.model and read.model != content:
        raise _wrong_model(file, read.model, content)
    sizes = (len(data.vertex_identity_basis), len(data.expression_basis))
    found = (read.identity.shape[1], read.expression.shape[1])
    if sizes != found:
        raise InputError(
            "The coefficients do not fit the model",
            where=file,
            expected=f"a model with {found[0]} identity and {found[1]} expression coefficients",
            got=f"{sizes[0]} and {sizes[1]}",
            fix="give the model that the captures were registered with",
        )


def _wrong_model(file: Path, expected: str, got: str) -> InputError:
    return InputError(
        "The coefficients belong to another model",
        where=file,
        expected=f"the model of content hash {expected[:16]}",
        got=got[:16],
        fix="give the model that the captures were registered with",
    )


def training_lines(record: SamplerRecord) -> list[str]:
    """Return the outcome of a training in sentences."""
    lines = [*record.remarks]
    for name, part in record.parts.items():
        m: Any = part.metrics
        accuracy = ", ".join(f"{factor} {value:.1%}" for factor, value in m.accuracy.items())
        lines.append(
            f"{name}: {part.training_samples} samples of {part.subjects} subjects, {record.seconds[name]:.0f} s; "
            f"{m.active_units} latent dimensions in use; draws have {m.within_draws / max(m.within, 1e-12):.0%} of the "
            f"variance within classes; classified as wanted: {accuracy}"
        )
        if m.status != "trained":
            lines.append(f"{name}: {m.status}: {m.reason}")
    return lines
