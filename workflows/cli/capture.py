"""`gnmreg capture ...` and `dataset synth`: captures checked, rendered and degraded."""

import sys
from collections.abc import Sequence
from typing import Annotated, Literal

from tyro.conf import arg

from registration.errors import InputError
from registration.options import RegisterOptions
from workflows.cli.options import (
    NOT_SET,
    CaptureFolder,
    Folder,
    ModelFile,
    OptionalFolder,
    OptionalImage,
    OptionalRegistration,
    OutputFolder,
    Seed,
    StudioOptions,
    weights,
)

_STUDIO, _DEFAULTS = StudioOptions(), RegisterOptions()


def check(
    capture: CaptureFolder,
    /,
    out: OptionalImage = None,
    fix: OptionalFolder = None,
    explain: OptionalImage = None,
) -> int:
    """Check a capture folder before it is registered.

    All that is wrong is listed, each with what mends it; the exit code is 2 if a registration would refuse the capture.

    Args:
        capture: The capture folder.
        out: Contact sheet to draw (with --fix of the copy): every image, with scan and landmarks projected into it.
        fix: Folder for a mended copy: what has one mend is mended, doctor.txt says what was done and what is left.
        explain: Picture to draw of the rig: cameras, head and scan from three sides, with what is wrong in words.
    """
    from registration.capture.native_writer import check_new
    from registration.doctor import mending, report
    from registration.doctor.diagnosis import diagnose
    from registration.doctor.rig_picture import draw_rig
    from registration.storage.files import check_output_file

    for picture in (out, explain):
        if picture is not None:
            check_output_file(picture)
    if fix is not None:
        check_new(fix)
    diagnosis = diagnose(capture)
    if explain is not None:
        draw_rig(diagnosis, explain)
    if fix is not None:
        mended = mending.mend_capture(capture, fix, diagnosis)
        print(mended)
        usable = mended.usable
        if usable and out is not None:
            report.check_capture(mended.out or capture, sheet=out)
    elif usable := not diagnosis.errors:
        print(report.report_capture(diagnosis, sheet=out))
    else:
        print(diagnosis, file=sys.stderr)
        for finding in diagnosis.findings:
            if finding.severity == "warning":
                print(f"warning: {finding.line}")
    if out is not None and not usable:
        print(f"{out} was not drawn: the contact sheet shows captures without errors", file=sys.stderr)
    return 0 if usable else 2


def complete(
    capture: CaptureFolder,
    /,
    *,
    model: ModelFile,
    out: Folder,
    neutral: OptionalRegistration = None,
    fit: RegisterOptions = _DEFAULTS,
) -> int:
    """Copy a capture with the landmarks, masks, labels and normals that it lacks.

    They are made from its photographs, as `gnmreg register` makes them. Look at made.jpg, correct the files in
    landmarks, masks and segmentation, and register the copy: what it has is not made again.

    Args:
        capture: The capture folder; it is not changed.
        model: The head model, a GNM NPZ file.
        out: The capture folder to write; it must not exist.
        neutral: The registration of the same subject's neutral, for an expression.
        fit: How the capture would be registered; its views, detector and stereo count here.
    """
    from registration.preparation import write_completed
    from registration.progress import console_progress

    with console_progress() as progress:
        made = write_completed(capture, model, out, fit, neutral=neutral, progress=progress)
    for note in made.notes:
        print(f"note: {note}")
    print(f"made {', '.join(made.figures['channels'])}: look at {out / 'made.jpg'}\n{out}")
    return 0


def detect(
    capture: CaptureFolder,
    /,
    provider: Annotated[str, arg(metavar="NAME")] = "face478",
    out: OptionalFolder = None,
    write: bool = False,
    replace: bool = False,
) -> int:
    """Detect landmarks in the photographs of a capture and compare its views.

    Nothing is written without --out or --write. The exit code is 2 if no landmarks can be used.

    Args:
        capture: The capture folder; it needs images and cameras.
        provider: face478 (Google's face landmarker), files:FOLDER or files:FOLDER:SCHEME (landmark files), or
            MODULE:FUNCTION, a provider of one's own.
        out: Folder for landmarks/NAME.json, detections.png with every view, and detections.json.
        write: Add the landmarks to the capture's own landmark files; other schemes stay.
        replace: With --write, replace landmarks of the same scheme.
    """
    from registration.capture.native import read_capture
    from registration.detect import written
    from registration.detect.detection import detect_landmarks
    from registration.detect.pictures import draw_detections
    from registration.detect.providers import load_source
    from registration.progress import console_progress
    from registration.storage.files import refuse_foreign

    if out is not None:
        refuse_foreign(out, kind=written.KIND, command="capture detect", manifest=written.DETECTIONS)
    source, read = load_source(provider), read_capture(capture)
    if write and not replace:
        written.check_scheme_is_new(read, source.scheme)
    with console_progress() as progress:
        found = detect_landmarks(read, source, progress=progress)
    if out is not None:
        draw_detections(read, found, out / written.SHEET)
        written.write_detections(found, out / written.DETECTIONS)
        print(out / written.SHEET)
    for view in found.views:
        print(f"{view.name:>12}  {view.caption}")
    print(found.reason)
    for warning in found.warnings:
        print(f"warning: {warning}")
    if not found.usable:
        raise found.error(read)
    for folder in [folder for folder in (out, capture if write else None) if folder is not None]:
        print(f"{len(written.write_landmark_files(read, found, folder))} landmark files in {folder / 'landmarks'}")
    return 0


def synth(
    out: OutputFolder,
    /,
    seed: Seed = 0,
    expression: Annotated[str, arg(metavar="NAME")] = "neutral",
    spanned: bool = False,
    target: Annotated[tuple[str, ...], arg(metavar="NAME=WEIGHT", help_behavior_hint=NOT_SET)] = (),
    studio: StudioOptions = _STUDIO,
) -> int:
    """Render a capture of a synthetic subject, with ground truth.

    Args:
        out: The capture folder to write; it must not exist.
        seed: The subject: each seed is one person with one skin, and one arrangement of cameras.
        expression: A named expression, such as neutral, jaw_open, smile, gaze_left, tongue_out.
        spanned: Sample a person that the first model spans; otherwise asymmetry, age and build exceed it.
        target: Weights of MakeHuman targets, such as nose/nose-hump-incr=0.5.
        studio: The synthetic studio.
    """
    targets = weights(target)
    from coregister.synthetic.subject import synthesize_capture

    root = synthesize_capture(
        out, seed=seed, expression=expression, spanned=spanned, targets=targets, studio=studio.studio(seed)
    )
    print(root)
    return 0


def degrade(
    source: CaptureFolder,
    target: OutputFolder,
    /,
    preset: Literal["none", "studio", "harsh"] = "studio",
    seed: Seed = 0,
    faults: Annotated[tuple[str, ...], arg(name="break", metavar="VIEW=FAULT", help_behavior_hint=NOT_SET)] = (),
) -> int:
    """Copy a clean capture with realistic errors, to measure robustness.

    Calibration, normals, landmarks, masks, labels and images get errors; scan and ground truth stay.

    Args:
        source: The capture folder; it is not changed.
        target: The capture folder to write; it must not exist.
        preset: studio: the errors that remain in a good studio; harsh: about twice those; none: no errors.
        seed: Seed of the errors.
        faults: Views with a fault: shifted (by 30 px), black, or exposure (2.5 times the light). They are kept.
    """
    parsed = _faults(faults)
    from registration.degrading import degradation, degrade

    print(degrade.degrade(source, target, preset=degradation.PRESETS[preset], seed=seed, faults=parsed))
    return 0


def synth_dataset(
    out: OutputFolder,
    /,
    subjects: Annotated[int, arg(metavar="N")],
    expressions: Annotated[str, arg(metavar="A,B,C", help_behavior_hint=NOT_SET)] = "",
    seed: Seed = 0,
    held_out: Annotated[int, arg(metavar="N")] = 0,
    jobs: Annotated[int, arg(metavar="N")] = 1,
    studio: StudioOptions = _STUDIO,
) -> int:
    """Render a dataset of synthetic subjects, with ground truth.

    Run again, the command resumes.

    Args:
        out: The dataset's folder: one folder for each subject, with one capture for each expression.
        subjects: Number of subjects, of any adult age and build, beyond what the first model spans.
        expressions: Named expressions besides the neutral, separated by commas.
        seed: The population: no two seeds share a subject.
        held_out: Number of subjects, the last ones, that are marked to be held out of models.
        jobs: Captures rendered in parallel.
        studio: The synthetic studio.
    """
    from registration.progress import console_progress
    from workflows.steps.synthesize import Population, synth_dataset

    names = tuple(name.strip() for name in expressions.split(",") if name.strip())
    population = Population(subjects=subjects, expressions=names, seed=seed, held_out=held_out, studio=studio.studio())
    with console_progress() as progress:
        synth_dataset(out, population, jobs=jobs, progress=progress)
    print(out)
    return 0


def _faults(pairs: Sequence[str]) -> dict[str, set[str]]:
    """Parse `VIEW=FAULT` arguments; a view may have several faults."""
    parsed: dict[str, set[str]] = {}
    for pair in pairs:
        view, _, fault = pair.rpartition("=")
        if not (view and fault):
            raise InputError(
                "Cannot read a view's fault",
                where="--break",
                expected="VIEW=FAULT, e.g. cam03=shifted",
                got=pair,
                fix="write the view's name, an equals sign and one of shifted, black, exposure",
            )
        parsed.setdefault(view, set()).add(fault)
    return parsed
