"""Option groups and argument types that several commands share.

tyro adds the fields of these dataclasses to a command's options and shows their docstrings as help. Nothing heavy is
imported here, so that help stays fast.
"""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, Suppress, arg

from registration.errors import InputError
from registration.options import RegisterOptions

if TYPE_CHECKING:
    from coregister.evaluate.face_protocol import ProtocolSettings
    from coregister.synthetic.capture import Studio

NOT_SET = "(optional)"
Command = Callable[..., int]

CaptureFolder = Positional[Annotated[Path, arg(metavar="CAPTURE")]]
OutputFolder = Positional[Annotated[Path, arg(metavar="DIR")]]
RunName = Positional[Annotated[str, arg(metavar="RUN")]]
JobId = Positional[Annotated[str, arg(metavar="JOB")]]
StoreUrl = Positional[Annotated[str, arg(metavar="STORE")]]
Folder = Annotated[Path, arg(metavar="DIR")]
ModelFile = Annotated[Path, arg(metavar="NPZ")]
Seed = Annotated[int, arg(metavar="S")]
Port = Annotated[int, arg(metavar="PORT")]
OptionalFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NOT_SET)]
OptionalFolder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint=NOT_SET)]
OptionalRegistration = Annotated[Path | None, arg(metavar="REG", help_behavior_hint=NOT_SET)]
OptionalCapture = Annotated[Path | None, arg(metavar="CAPTURE", help_behavior_hint=NOT_SET)]
OptionalImage = Annotated[Path | None, arg(metavar="PNG", help_behavior_hint=NOT_SET)]
OptionalModel = Annotated[Path | None, arg(metavar="NPZ", help_behavior_hint=NOT_SET)]


@dataclass(frozen=True, kw_only=True)
class JobOptions(RegisterOptions):
    """How jobs register captures: as in this process, but with the landmark files next to the model."""

    landmark_files: Annotated[Mapping[str, Path], Suppress] = field(default_factory=dict)

    def register_options(self) -> RegisterOptions:
        """Return the library's options, whose type is part of input hashes."""
        return RegisterOptions(**{item.name: getattr(self, item.name) for item in fields(RegisterOptions)})


@dataclass(frozen=True, kw_only=True)
class FaceSettings:
    """How models are compared on the face.

    Attributes:
        points: Points of each scan to fit, and as many others to measure at.
        components: Numbers of components of the generalization curves, besides all.
        curve_samples: Neutrals, and expressions, of these curves.
        adam_steps: Steps of Adam in each stage, as a check of the least squares; 0: none.
        adam_rate: Learning rate of Adam.
        adam_samples: Registered scans that Adam fits too.
        random_heads: Random heads of each model, for specificity; 0: no specificity.
        seed: Seed of points and random heads.
    """

    points: Annotated[int, arg(metavar="N")] = 3000
    components: Annotated[tuple[int, ...], arg(metavar="K")] = (5, 10, 20, 40)
    curve_samples: Annotated[int, arg(metavar="N")] = 40
    adam_steps: Annotated[int, arg(metavar="N")] = 5000
    adam_rate: Annotated[float, arg(metavar="R")] = 1e-3
    adam_samples: Annotated[int, arg(metavar="N")] = 15
    random_heads: Annotated[int, arg(metavar="N")] = 2000
    seed: Seed = 0

    def protocol(self) -> "ProtocolSettings":
        """Return the settings of the protocol. Raises InputError for numbers out of range."""
        from coregister.evaluate.face_adam import AdamSettings
        from coregister.evaluate.face_protocol import ProtocolSettings

        adam = AdamSettings(steps=self.adam_steps, rate=self.adam_rate)
        own = {item.name: getattr(self, item.name) for item in fields(self) if not item.name.startswith("adam_")}
        settings = ProtocolSettings(adam=adam, adam_samples=self.adam_samples, **own)
        settings.check()
        return settings


@dataclass(frozen=True, kw_only=True)
class StudioOptions:
    """The synthetic studio that renders captures.

    Attributes:
        views: Number of cameras.
        size: Width and height of the images in pixels.
        distortion: Give the cameras lens distortion.
        noise: Add sensor noise, and differences of exposure and colour between the cameras.
        hair: Add hair, with a label of its own.
        shirt: Add a shirt, with a label of its own.
    """

    views: Annotated[int, arg(metavar="N")] = 22
    size: Annotated[tuple[int, int], arg(metavar="W H")] = (480, 720)
    distortion: bool = False
    noise: bool = False
    hair: bool = False
    shirt: bool = False

    def studio(self, seed: int = 0) -> "Studio":
        """Return the library's settings."""
        from coregister.synthetic.capture import Studio
        from registration.render.studio.shoot import Sensor

        noisy = Sensor(shot_noise=0.01, read_noise=0.002, exposure_spread=0.05, colour_spread=0.03)
        return Studio(
            cameras=self.views,
            size_px=self.size,
            distortion=self.distortion,
            seed=seed,
            sensor=noisy if self.noise else Sensor(),
            hair=self.hair,
            shirt=self.shirt,
        )


@dataclass(frozen=True, kw_only=True)
class FarmOptions:
    """Which farm: the folder of its logs, and its queue.

    Attributes:
        folder: Folder of the farm: job logs and, unless --db names a database, the queue. A folder that holds a queue
            beats the environment variable GNMREG_DB.
        db: Database of the queue: sqlite:///FILE or postgresql://... Pass a URL with a password as the environment
            variable GNMREG_DB: other users of the machine can read command lines. --db GNMREG_DB takes that one, also
            if the folder holds a queue.
    """

    folder: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: the current folder)")] = None
    db: Annotated[
        str | None,
        arg(metavar="URL", help_behavior_hint="(default: the queue in --folder, $GNMREG_DB, or queue.sqlite here)"),
    ] = None

    @property
    def directory(self) -> Path:
        """The farm's folder."""
        return self.folder or Path(".")

    @property
    def url(self) -> str:
        """URL of the queue's database.

        Raises:
            InputError: a URL that cannot be used.
        """
        return queue_url(self.directory, self.db, own=self.folder is not None and has_queue(self.folder))


@dataclass(frozen=True, kw_only=True)
class RunOptions(FarmOptions):
    """Where a run's jobs are executed: by a farm, or with --local on this machine.

    Attributes:
        local: Start a coordinator and workers on this machine, wait for the run to end, and stop them. Otherwise
            the jobs wait in the queue for a farm's workers.
        workers: With --local: captures registered in parallel. With --variant cuda there is one worker for each GPU
            instead.
        folder: Folder of the farm: job logs and, unless --db names a database, the queue.
    """

    local: bool = False
    workers: Annotated[int, arg(metavar="N")] = 1
    folder: Annotated[
        Path | None,
        arg(metavar="DIR", help_behavior_hint="(default: the current folder; with --local, OUT.farm beside --out)"),
    ] = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            fix = "use one or more"
            raise InputError(
                "There are no workers", where="--workers", expected="at least 1", got=self.workers, fix=fix
            )

    def farm_folder(self, out: str | Path) -> Path:
        """Return the farm's folder for a run whose results go to `out`.

        Raises:
            InputError: a local farm without a folder whose results go to a URL.
        """
        if self.folder is not None or not self.local:
            return self.directory
        from workflows.ids import is_remote, resolve_place

        place = resolve_place(str(out), "--out")
        if is_remote(place):
            raise InputError(
                "A farm on this machine needs a folder",
                where="--folder",
                expected="a folder for its queue and logs, as the results go to a URL",
                got="none",
                fix="add --folder DIR",
            )
        path = Path(place)
        return path.with_name(f"{path.name}.farm")

    def url_for(self, folder: Path) -> str:
        """Return the URL of the queue's database, for a farm in `folder`. With --local it has a queue of its own."""
        return queue_url(folder, self.db, own=self.local or (self.folder is not None and has_queue(self.folder)))


def has_queue(folder: Path) -> bool:
    """Return whether there is a SQLite queue in a farm's folder."""
    from workflows.engine.database import FILE

    return (folder / FILE).is_file()


def queue_url(folder: Path, db: str | None, *, own: bool) -> str:
    """Return the URL of the queue's database.

    Args:
        folder: of the farm.
        db: a URL, or "GNMREG_DB" for the one in that environment variable; None: choose.
        own: choose the SQLite file in the folder, also if the environment variable is set.

    Raises:
        InputError: a URL that cannot be used, or the environment variable is not set.
    """
    from workflows.engine.database import ENVIRONMENT, checked_url, default_url

    environment = os.environ.get(ENVIRONMENT)
    if db == ENVIRONMENT and not environment:
        raise InputError(
            "The environment names no queue",
            where=f"--db {ENVIRONMENT}",
            expected=f"a URL in the environment variable {ENVIRONMENT}",
            got="none",
            fix=f"set {ENVIRONMENT}, or leave out --db",
        )
    if db is None and own:
        if environment:
            print(f"the queue is in {folder}; {ENVIRONMENT} is not used (--db {ENVIRONMENT} takes it)", file=sys.stderr)
        return checked_url(default_url(folder))
    return checked_url((environment if db in (None, ENVIRONMENT) else db) or default_url(folder))


def weights(pairs: Sequence[str]) -> Mapping[str, float]:
    """Parse `NAME=WEIGHT` arguments.

    Raises:
        InputError: an argument of another form.
    """
    parsed = {}
    for pair in pairs:
        name, _, weight = pair.rpartition("=")
        try:
            parsed[name] = float(weight)
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
    return parsed
