"""The command line, `gnmreg`: every command reads its arguments, calls the library once and prints the outcome.

The library is imported inside the commands, so that help and typing errors never wait for torch or mitsuba.
Exit codes: 0 done; 1 a registration, or some of a subject's, that failed; 2 arguments or input that cannot be used, or
a subject of which nothing can; 130 interrupted.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro
from tyro.conf import Positional, arg, subcommand

from registration.errors import InputError
from workflows.cli import farm

CaptureFolder = Positional[Annotated[Path, arg(metavar="CAPTURE")]]
RegistrationFolder = Positional[Annotated[Path, arg(metavar="REG")]]
SubjectFolder = Positional[Annotated[Path, arg(metavar="SUBJECT")]]
RunFolder = Positional[Annotated[Path, arg(metavar="RUN")]]
NeutralFolder = Annotated[Path | None, arg(metavar="REG")]


def register(
    capture: CaptureFolder,
    /,
    model: Annotated[Path, arg(metavar="NPZ")],
    out: Annotated[Path, arg(metavar="DIR")],
    recipe: Literal["preview", "draft", "studio", "in_model"] = "draft",
    views: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="S")] = 0,
    neutral: NeutralFolder = None,
    deterministic: bool = False,
    force: bool = False,
    variant: Literal["llvm", "cuda"] = "llvm",
    landmarks: Annotated[tuple[str, ...], arg(metavar="SCHEME=FILE")] = (),
) -> int:
    """Register one capture: images and cameras in, the model's mesh of that moment out.

    Args:
        capture: The capture folder.
        model: The head model, a GNM NPZ file.
        out: The registration folder to write; one that gnmreg wrote before is replaced.
        recipe: draft takes minutes and checks that a capture works; studio is the full quality.
        views: Use only this many views, spread around the head.
        seed: Seed of everything random.
        neutral: Start from this registration of the same subject and keep its identity.
        deterministic: Make every array the same from run to run; slower.
        force: Register again although the folder holds the result of the same input.
        variant: Render on the CPU (llvm) or on an NVIDIA GPU (cuda).
        landmarks: The model's vertices of a landmark scheme, instead of the file beside the model.
    """
    landmark_files = _landmark_files(landmarks)
    from registration.progress import shown
    from registration.register import register

    with shown() as progress:
        result = register(
            capture,
            model_path=model,
            out=out,
            recipe=recipe,
            views=views,
            seed=seed,
            neutral=neutral,
            deterministic=deterministic,
            force=force,
            variant=variant,
            landmark_files=landmark_files,
            progress=progress,
        )
    print(f"{result.status}: {result.reason}\n{out}")
    return 1 if result.status == "failed" else 0


def register_subject(
    subject: SubjectFolder,
    /,
    model: Annotated[Path, arg(metavar="NPZ")],
    out: Annotated[Path, arg(metavar="DIR")],
    recipe: Literal["preview", "draft", "studio", "in_model"] = "draft",
    views: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="S")] = 0,
    neutral: Annotated[str | None, arg(metavar="NAME")] = None,
    deterministic: bool = False,
    force: bool = False,
    variant: Literal["llvm", "cuda"] = "llvm",
    landmarks: Annotated[tuple[str, ...], arg(metavar="SCHEME=FILE")] = (),
) -> int:
    """Register all captures of a subject: the neutral, then every expression from it. Run again, it goes on.

    Args:
        subject: The folder whose sub-folders are the captures.
        model: The head model, a GNM NPZ file.
        out: The folder to write: a registration for each capture, subject.json and index.html.
        recipe: draft takes minutes a capture and checks that they work; studio is the full quality.
        views: Use only this many views of each capture, spread around the head.
        seed: Seed of everything random.
        neutral: The sub-folder of the neutral, if it is not the one whose expression is "neutral".
        deterministic: Make every array the same from run to run; slower.
        force: Register again what is there already.
        variant: Render on the CPU (llvm) or on an NVIDIA GPU (cuda).
        landmarks: The model's vertices of a landmark scheme, instead of the file beside the model.
    """
    landmark_files = _landmark_files(landmarks)
    from registration.progress import shown
    from workflows.steps.subject import register_subject

    with shown() as progress:
        result = register_subject(
            subject,
            model_path=model,
            out=out,
            recipe=recipe,
            views=views,
            seed=seed,
            neutral=neutral,
            deterministic=deterministic,
            force=force,
            variant=variant,
            landmark_files=landmark_files,
            progress=progress,
        )
    for row in result.rows:
        print(f"{row.name}: {row.status}: {row.reason}")
    print(out / "index.html")
    usable = sum(row.usable for row in result.rows)
    return 0 if usable == len(result.rows) else 1 if usable else 2


def evaluate(
    registration: RegistrationFolder,
    /,
    capture: Annotated[Path, arg(metavar="CAPTURE")],
    neutral: NeutralFolder = None,
    neutral_capture: Annotated[Path | None, arg(metavar="CAPTURE")] = None,
) -> int:
    """Compare a registration with its capture's scan and ground truth; print the figures and store them with it.

    Args:
        registration: The registration folder.
        capture: The capture that it registers.
        neutral: The same subject's neutral registration: adds the drift of the surface against it.
        neutral_capture: The capture of that neutral registration.
    """
    from registration.evaluate.evaluation import evaluate_folder

    evaluate_folder(registration, capture, neutral, neutral_capture)
    return 0


def stabilize(
    run: RunFolder,
    /,
    decisions: Annotated[Path | None, arg(metavar="FILE")] = None,
    model: Annotated[Path | None, arg(metavar="NPZ")] = None,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
    skip_failed: bool = False,
    force: bool = False,
) -> int:
    """Take the head's motion out of expressions, so that the skull stands still: automatically, then over all subjects.

    Args:
        run: A folder of subject folders that `gnmreg subject` wrote, or one such folder.
        decisions: A log that `gnmreg stabilize review` saved; without one, what is flagged is subtracted.
        model: The head model of the registrations; not needed if it is the first or the official one.
        out: The folder to write, RUN/stabilized by default.
        skip_failed: Leave registrations out that failed.
        force: Stabilize again although the folder holds the result of the same input.
    """
    from registration.progress import shown
    from workflows.records.run import known_model
    from workflows.steps.stabilize import stabilize_run

    with shown() as progress:
        outcome = stabilize_run(
            run,
            model_path=model or known_model(run),
            out=out,
            decisions=decisions,
            skip_failed=skip_failed,
            force=force,
            progress=progress,
        )
    figures = outcome.figures
    print(f"{figures['samples']} expressions; {figures['residual_median_mm']:.2f} mm of skin on the skull, median")
    print(f"the second stage turned by {figures['regional_turn_deg']:.2f} degrees, moved by", end=" ")
    print(f"{figures['regional_rms_mm']:.2f} mm, rms")
    print(outcome.out / "index.html")
    return 0


def review_stabilization(
    run: RunFolder,
    /,
    decisions: Annotated[Path | None, arg(metavar="FILE")] = None,
    model: Annotated[Path | None, arg(metavar="NPZ")] = None,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
    skip_failed: bool = False,
    port: Annotated[int, arg(metavar="PORT")] = 8080,
) -> int:
    """Look at the components of a stabilized run in the browser and decide about each; stops with Ctrl-C.

    Args:
        run: As for `gnmreg stabilize`, which is done first where needed.
        decisions: The log to go on from and to save into, RUN/decisions.jsonl by default.
        model: The head model of the registrations; not needed if it is the first or the official one.
        out: The folder of the stabilized set, RUN/stabilized by default.
        skip_failed: Leave registrations out that failed.
        port: Where to serve, on this machine only; from elsewhere: ssh -L PORT:127.0.0.1:PORT HOST.
    """
    from registration.progress import shown
    from workflows.records.run import known_model
    from workflows.web.review import review

    with shown() as progress:
        page = review(
            run,
            model_path=model or known_model(run),
            out=out,
            decisions=decisions,
            skip_failed=skip_failed,
            port=port,
            progress=progress,
        )
    print(f"Open {page.url} in a browser; Ctrl-C ends.", flush=True)
    page.wait()
    return 0


def check_capture(capture: CaptureFolder, /, out: Annotated[Path | None, arg(metavar="PNG")] = None) -> int:
    """Check a capture folder before any fitting.

    Args:
        capture: The capture folder.
        out: Where to draw the contact sheet: every image with the scan and the landmarks projected into it.
    """
    from registration.capture.doctor import check

    print(check(capture, sheet=out))
    return 0


def synth_capture(
    out: Positional[Annotated[Path, arg(metavar="DIR")]],
    /,
    seed: Annotated[int, arg(metavar="S")] = 0,
    expression: Annotated[str, arg(metavar="NAME")] = "neutral",
    spanned: bool = False,
    target: Annotated[tuple[str, ...], arg(metavar="NAME=WEIGHT")] = (),
    views: Annotated[int, arg(metavar="N")] = 22,
    size: Annotated[tuple[int, int], arg(metavar="W H")] = (480, 720),
    distortion: bool = False,
    noise: bool = False,
    hair: bool = False,
    shirt: bool = False,
) -> int:
    """Photograph a synthetic subject in a synthetic studio: a capture whose truth is known.

    Args:
        out: The capture folder to write; it must not exist.
        seed: The subject: one seed is one person with one skin, and one rig of cameras.
        expression: One of the named expressions, such as neutral, jaw_open, smile, gaze_left, tongue_out.
        spanned: Draw a person that the first model spans; otherwise asymmetry, age and build go beyond it.
        target: Weight of a MakeHuman target, such as nose/nose-hump-incr=0.5.
        views: The number of cameras.
        size: Width and height of the images in pixels.
        distortion: Give the lenses distortion.
        noise: Add sensor noise, and differences of exposure and colour between the cameras.
        hair: Put hair on the head, with its own label.
        shirt: Put a shirt on the shoulders, with its own label.
    """
    targets = _target_weights(target)
    from coregister.synthetic.capture import Studio
    from coregister.synthetic.subject import capture

    studio = Studio(
        cameras=views, size_px=size, distortion=distortion, seed=seed, sensor=_sensor(noise), hair=hair, shirt=shirt
    )
    print(capture(out, seed=seed, expression=expression, spanned=spanned, targets=targets, studio=studio))
    return 0


def spoil_capture(
    source: CaptureFolder,
    target: Positional[Annotated[Path, arg(metavar="DIR")]],
    /,
    preset: Literal["none", "studio", "harsh"] = "studio",
    seed: Annotated[int, arg(metavar="S")] = 0,
    breaks: Annotated[tuple[str, ...], arg(name="break", metavar="VIEW=HOW")] = (),
) -> int:
    """Copy a good capture with the errors that real ones have: what a registration of it loses can be measured.

    Args:
        source: The capture folder; it stays as it is.
        target: The capture folder to write; it must not exist.
        preset: studio is what a good studio leaves, harsh about twice that; none changes nothing.
        seed: Seed of everything random: one seed is one copy.
        breaks: Break a view, which is not dropped then: shifted (by 30 px), black, or exposure (2.5 times the light).
    """
    broken = _broken_views(breaks)
    from registration.capture.degrade import PRESETS, spoil

    print(spoil(source, target, preset=PRESETS[preset], seed=seed, breaks=broken))
    return 0


def describe_model(
    file: Positional[Annotated[Path, arg(metavar="NPZ")]], /, out: Annotated[Path | None, arg(metavar="PNG")] = None
) -> int:
    """Tell what is in a model file: dimensions, parts and regions.

    Args:
        file: The head model, a GNM NPZ file.
        out: Where to draw the model.
    """
    from registration.model.info import describe

    describe(file, picture=out)
    return 0


def synth_dataset(
    out: Positional[Annotated[Path, arg(metavar="DIR")]],
    /,
    subjects: Annotated[int, arg(metavar="N")],
    expressions: Annotated[str, arg(metavar="A,B,C")] = "",
    seed: Annotated[int, arg(metavar="S")] = 0,
    held_out: Annotated[int, arg(metavar="N")] = 0,
    views: Annotated[int, arg(metavar="N")] = 22,
    size: Annotated[tuple[int, int], arg(metavar="W H")] = (480, 720),
    distortion: bool = False,
    noise: bool = False,
    hair: bool = False,
    shirt: bool = False,
    jobs: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Photograph a population of synthetic subjects: a dataset whose truth is known. Run again, it goes on.

    Args:
        out: The dataset's folder: a folder a subject, in it a capture an expression.
        subjects: How many people; of any adult age and build, beyond what the first model spans.
        expressions: Named expressions beside the neutral, with commas between them.
        seed: The population: one seed is one set of people, and no two seeds share any.
        held_out: So many of them, the last ones, are marked to be held out of models.
        views: The number of cameras.
        size: Width and height of the images in pixels.
        distortion: Give the lenses distortion.
        noise: Add sensor noise, and differences of exposure and colour between the cameras.
        hair: Put hair on the heads, with its own label.
        shirt: Put shirts on the shoulders, with their own label.
        jobs: Captures that are made side by side.
    """
    from coregister.synthetic.capture import Studio
    from registration.progress import shown
    from workflows.steps.synthesize import Population, synth_dataset

    acts = tuple(name.strip() for name in expressions.split(",") if name.strip())
    studio = Studio(cameras=views, size_px=size, distortion=distortion, sensor=_sensor(noise), hair=hair, shirt=shirt)
    population = Population(subjects=subjects, expressions=acts, seed=seed, held_out=held_out, studio=studio)
    with shown() as progress:
        synth_dataset(out, population, jobs=jobs, progress=progress)
    print(out)
    return 0


def evaluate_model(
    models: Positional[Annotated[tuple[Path, ...], arg(metavar="MODEL")]],
    /,
    held_out: Annotated[Path, arg(metavar="RUN|NPZ")],
    out: Annotated[Path, arg(metavar="DIR")],
    captures: Annotated[Path | None, arg(metavar="DIR")] = None,
    components: Annotated[tuple[int, ...], arg(metavar="K")] = (5, 10, 20, 40),
    samples: Annotated[int, arg(metavar="N")] = 200,
    seed: Annotated[int, arg(metavar="S")] = 0,
    force: bool = False,
) -> int:
    """Measure head models on people that they were not made from; others are compared with the first one.

    Args:
        models: The head models, GNM NPZ files of one topology.
        held_out: A folder of subject folders that `gnmreg subject` wrote, or an NPZ file of meshes.
        out: The folder to write; one that this command wrote before is replaced.
        captures: The folder of the run's subjects with their captures: adds scans, categories and tags.
        components: Numbers of components to measure with; all are, besides.
        samples: Random heads of each model, for specificity; 0 leaves it out.
        seed: Seed of everything random.
        force: Measure again although the folder holds the result of the same input.
    """
    from coregister.evaluate.evaluation import Settings
    from registration.progress import shown
    from workflows.steps.evaluate import PAGE, evaluate_models, lines

    settings = Settings(components=components, samples=samples, seed=seed)
    with shown() as progress:
        manifest = evaluate_models(
            models,
            held_out=held_out,
            out=out,
            captures=captures,
            settings=settings,
            force=force,
            progress=progress,
        )
    print("\n".join((*lines(manifest), str(out / PAGE))))
    return 0


def fetch_model() -> int:
    """Download Google's GNM head weights into the cache and print where they lie."""
    from registration.model.fetch import fetch

    print(fetch())
    return 0


def bootstrap_model(out: Annotated[Path | None, arg(metavar="NPZ")] = None) -> int:
    """Make the first model from MakeHuman's CC0 head and print where it lies. Made once, then found in the cache.

    Args:
        out: Where to put a copy of the model file; its landmark schemes go beside it.
    """
    from coregister.first_model.build import bootstrap

    print(bootstrap(out))
    return 0


Command = Callable[..., int]
Group = tuple[str, Mapping[str, Command]]  # what the group is about, its commands

COMMANDS: Mapping[str, Command | Group] = {
    "register": register,
    "subject": register_subject,
    "evaluate": evaluate,
    "stabilize": stabilize,
    "stabilize review": review_stabilization,
    "dataset": ("Make whole datasets.", {"synth": synth_dataset}),
    "capture": (
        "Look at captures, make synthetic ones, spoil good ones.",
        {"check": check_capture, "synth": synth_capture, "spoil": spoil_capture},
    ),
    "model": (
        "Look at head models, measure them, make the first one, get the official one.",
        {"info": describe_model, "evaluate": evaluate_model, "bootstrap": bootstrap_model, "fetch": fetch_model},
    ),
    **farm.COMMANDS,
}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; `args` replaces the process' own. Returns the exit code."""
    args = list(sys.argv[1:] if args is None else args)
    if args[:2] == ["stabilize", "review"]:  # a command that has both an argument and a command below it
        args[:2] = ["stabilize review"]
    try:
        _check_said_once(args)
        return tyro.cli(
            _choice(COMMANDS),
            prog="gnmreg",
            description="Multi-view captures of human heads into clean meshes of one topology.",
            args=args,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
        )
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _choice(commands: Mapping[str, Command | Group]) -> Any:
    """The type that makes tyro offer these commands."""
    choices: list[Any] = [Annotated[None, tyro.conf.Suppress]]  # tyro flattens a union of one
    for name, command in commands.items():
        if isinstance(command, tuple):
            description, members = command
            choices.append(Annotated[_choice(members), subcommand(name, description=description)])
        else:
            choices.append(Annotated[Any, subcommand(name, constructor=command)])
    return Union[tuple(choices)]  # noqa: UP007  a union of types that only exist at run time


def _check_said_once(args: Sequence[str]) -> None:
    """Of an option that comes twice the parser would take the last and forget the other."""
    said = [word.partition("=")[0].replace("_", "-") for word in args if word.startswith("--")]
    for option in said:
        if said.count(option) > 1:
            raise InputError(
                "An option is given more than once",
                where=option,
                expected="each option once",
                got=f"{said.count(option)} times",
                fix=f"give it once; where it takes several values, all after one {option}",
            )


def _sensor(noise: bool) -> Any:
    from registration.render.studio.shoot import Sensor

    return Sensor(shot_noise=0.01, read_noise=0.002, exposure_spread=0.05, colour_spread=0.03) if noise else Sensor()


def _target_weights(pairs: Sequence[str]) -> dict[str, float]:
    """`NAME=WEIGHT` arguments as a mapping."""
    weights = {}
    for pair in pairs:
        name, _, weight = pair.rpartition("=")
        try:
            weights[name] = float(weight)
        except ValueError:
            name = ""
        if not name:
            raise InputError(
                "Cannot read a target's weight",
                where="--target",
                expected="NAME=WEIGHT, e.g. nose/nose-hump-incr=0.5",
                got=pair,
                fix="write the target's name, an equals sign and a number",
            )
    return weights


def _broken_views(pairs: Sequence[str]) -> dict[str, set[str]]:
    """`VIEW=HOW` arguments as a mapping; a view may come several times."""
    broken: dict[str, set[str]] = {}
    for pair in pairs:
        view, _, how = pair.rpartition("=")
        if not (view and how):
            raise InputError(
                "Cannot read how a view is broken",
                where="--break",
                expected="VIEW=HOW, e.g. cam03=shifted",
                got=pair,
                fix="write the view's name, an equals sign and one of shifted, black, exposure",
            )
        broken.setdefault(view, set()).add(how)
    return broken


def _landmark_files(pairs: Sequence[str]) -> dict[str, Path]:
    """`SCHEME=FILE` arguments as a mapping."""
    files = {}
    for pair in pairs:
        scheme, separator, file = pair.partition("=")
        if not (scheme and separator and file):
            raise InputError(
                "Cannot read a landmark file argument",
                where="--landmarks",
                expected="SCHEME=FILE, e.g. 68=head_sparse_68.txt",
                got=pair,
                fix="write the scheme's name, an equals sign and the path of the model's landmark file",
            )
        files[scheme] = Path(file)
    return files
