"""Completes the inputs of a registration with what the capture lacks, or writes the completed capture for a person."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from registration.capture.native_writer import check_new
from registration.capture.settings_text import without_tables
from registration.capture.triangulation import spreads_m
from registration.completion.complete import CODE, Completer
from registration.completion.costs import missing_notes
from registration.completion.first_fit import HeadFitter
from registration.completion.pictures import SHEET
from registration.completion.saved import CHANNELS, Completion, completed
from registration.detect.providers import load_provider
from registration.errors import InputError
from registration.inputs import RegistrationInputs, read_inputs, triangulated_landmarks
from registration.options import RegisterOptions
from registration.progress import NullProgress, Progress
from registration.render import backend
from registration.segment.fitted import CLASSES, UNLABELLED
from registration.storage import hashing
from registration.storage.files import atomic_directory


def complete_inputs(
    inputs: RegistrationInputs, options: RegisterOptions, device: torch.device, progress: Progress
) -> tuple[RegistrationInputs, Completion | None]:
    """Return the inputs with the channels that the capture lacked, and how they were made; None: nothing was.

    Args:
        inputs: of the registration; their plan says what is made.
        options: of the registration.
        device: of the renderer.
        progress: where to report to.

    Raises:
        InputError: nothing says where the head is.
    """
    if inputs.plan.empty:
        return replace(inputs, notes=(*inputs.notes, *missing_notes(inputs.capture))), None
    neutral = inputs.neutral
    fitter = HeadFitter(
        inputs.data,
        inputs.schemes,
        neutral=None if neutral is None else replace(neutral, translation=neutral.translation - inputs.origin),
        seed=options.seed,
        device=device,
    )
    provider = load_provider(options.detector)
    completer = Completer(inputs.plan, fitter, provider, inputs.origin, progress)
    key = hashing.input_hash(inputs.digests, {"made": inputs.plan.channels, "seed": options.seed, "code": CODE})
    completion = completed(inputs.capture, key, partial(completer.complete, inputs.capture), provider.scheme, progress)
    landmarks = triangulated_landmarks(completion.capture, inputs.schemes)
    completed_inputs = replace(
        inputs,
        capture=completion.capture,
        landmarks=landmarks,
        landmark_spread_m=spreads_m(completion.capture, landmarks),
        head_rows=completion.head_rows,
    )
    return completed_inputs, completion


def write_completed(
    capture: Path,
    model: Path,
    out: Path,
    options: RegisterOptions = RegisterOptions(),  # noqa: B008  frozen
    *,
    neutral: Path | None = None,
    progress: Progress | None = None,
) -> Completion:
    """Write a copy of a capture with everything that `register` would make for it, to be looked at and corrected.

    Args:
        capture: a native capture folder; it is not changed.
        model: an official GNM NPZ file.
        out: folder of the copy, which appears in one rename; it must not exist.
        options: of the registration.
        neutral: folder of the subject's neutral registration.
        progress: where to report to.

    Returns:
        What was made; its `capture` refers to the files in the cache.

    Raises:
        InputError: as `register`; `out` exists; the capture lacks nothing; or normals in other axes are stated.
    """
    progress = progress or NullProgress()
    check_new(out)
    inputs = read_inputs(Path(capture), Path(model), options, None if neutral is None else Path(neutral))
    for warning in inputs.ledger.warnings:
        progress.message(f"warning: {warning}")
    if inputs.plan.empty:
        raise InputError(
            "There is nothing to make",
            where=capture,
            expected="a capture without landmarks, masks, labels or normals, and options that let them be made",
            got="a capture that has them all, or --no-detect and --no-stereo",
            fix="register it as it is",
        )
    device = backend.activate(options.variant, deterministic=options.deterministic)
    torch.manual_seed(options.seed)
    _, completion = complete_inputs(inputs, options, device, progress)
    assert completion is not None
    settings = _settings(Path(capture), completion)
    with atomic_directory(out) as temporary:
        _copy_files(Path(capture), temporary)
        for channel in CHANNELS:
            _copy_files(completion.folder / channel, temporary / channel)
        shutil.copyfile(completion.sheet, temporary / SHEET)
        (temporary / "capture.toml").write_text(settings, "utf-8")
    return completion


def _settings(capture: Path, completion: Completion) -> str:
    """The text of the copy's capture.toml."""
    source = capture / "capture.toml"
    settings = source.read_text("utf-8-sig")
    if (
        any(view.normals_frame != "camera_opencv" for view in completion.capture.views if view.normals)
        and (completion.folder / "normals").is_dir()
    ):
        raise InputError(
            "Made normals cannot join the capture's",
            where=source,
            expected='no [normals] frame, or "camera_opencv", where only some views have normals',
            got="normals in other axes",
            fix="convert the capture's normals, or remove them",
        )
    if not (completion.folder / "segmentation").is_dir():
        return settings
    settings = without_tables(source, settings, {"segmentation"})
    classes = f"classes = {json.dumps(CLASSES)}\nignore = {json.dumps([UNLABELLED])}"
    return f"{settings.rstrip()}\n\n[segmentation]\n{classes}\n"


def _copy_files(source: Path, target: Path) -> None:
    """Copy all files of a folder, without permissions: the source may be read-only."""
    for file in sorted(source.rglob("*")):
        if file.is_file():
            copy = target / file.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            _join(file, copy)


def _join(source: Path, target: Path) -> None:
    """Copy a file; made landmarks join those that the view has in a file of its own."""
    if not (target.is_file() and target.suffix == ".json"):
        shutil.copyfile(source, target)
        return
    both = {**json.loads(source.read_text("utf-8")), **json.loads(target.read_text("utf-8-sig"))}
    target.write_text(json.dumps(both), "utf-8")
