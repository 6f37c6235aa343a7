"""The gate's rules: a verdict on each registration from its figures and saved thresholds (docs/gate.md)."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from registration.errors import check_seed
from registration.evaluate.names import REVERSED_SKIN_MM2
from registration.storage.records import Record
from workflows.gate.figures import FIGURES, Assessed, GateFigures

FOLDER, THRESHOLDS = "gate", "thresholds.json"  # folder within a farm's, and the file in it
Level = Literal["accept", "look", "reject"]
LEVELS: tuple[Level, ...] = ("accept", "look", "reject")  # from good to bad
LEVEL_TITLES: Mapping[Level, str] = {"accept": "accepted", "look": "for a person", "reject": "rejected"}
# What has to be measured for a registration to be accepted without a person, and the figures that measure it.
EVIDENCE: Mapping[str, tuple[str, ...]] = {
    "the surface": ("scan_mm", "normals_deg", "colour_levels", "depth_mm"),
    "the outline": ("scan_mm", "silhouette_px"),
    "the position of the face's parts": ("landmarks_px", "labels_percent"),
}


@dataclass(frozen=True, kw_only=True)
class Limit:
    """Values of a figure above which a person has to look, and above which the registration is rejected."""

    look: float | None = None  # None: no value asks for a look
    reject: float | None = None  # None: no value is rejected

    def level(self, value: float) -> Level:
        """Return the level of a value."""
        if self.reject is not None and value > self.reject:
            return "reject"
        return "look" if self.look is not None and value > self.look else "accept"


def _limit(look: float | None, reject: float | None = None) -> Any:
    return field(default_factory=lambda: Limit(look=look, reject=reject))


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """How thresholds were found from labelled registrations."""

    good: int  # labels
    bad: int
    spreads: float  # robust spreads above the good ones' median at which the limits lie
    recall: float  # share of the bad ones whose verdict is not `accept`, each judged without its own label
    false_alarms: float  # share of the good ones whose verdict is not `accept`, likewise


@dataclass(frozen=True, kw_only=True)
class GateThresholds(
    Record,
    kind="gnm-gate-thresholds",
    title="gate's thresholds",
    fix="correct the file, or write it again with `gnmreg gate calibrate`",
):
    """The limits of all rules. The unit of each limit is in its name; `figures.FIGURES` says what the figures are.

    Attributes:
        name: for people.
        stopped: verdict on a fit that was stopped before the mesh came to rest, if nothing else is wrong.
        sample_share: share of the accepted that a person is shown too, so that the gate's own error is measured.
        seed: of the choice of these.
        calibration: how the limits were found; None: they are the defaults, or a person's.
    """

    name: str = "default"
    stopped: Literal["accept", "look"] = "look"
    scan_mm: Limit = _limit(0.4, 2.0)
    landmarks_px: Limit = _limit(5.0, 25.0)
    worst_landmarks_px: Limit = _limit(12.0)
    far_landmarks_percent: Limit = _limit(10.0, 80.0)
    silhouette_px: Limit = _limit(3.0, 15.0)
    worst_silhouette_px: Limit = _limit(8.0)
    labels_percent: Limit = _limit(5.0, 40.0)
    worst_labels_percent: Limit = _limit(15.0)
    normals_deg: Limit = _limit(5.0, 30.0)
    worst_normals_deg: Limit = _limit(15.0)
    colour_levels: Limit = _limit(10.0, 60.0)
    worst_colour_levels: Limit = _limit(25.0)
    depth_mm: Limit = _limit(0.6, 5.0)
    intersections_mm: Limit = _limit(6.0)
    intersecting_vertices: Limit = _limit(400.0)
    reversed_skin_mm2: Limit = _limit(REVERSED_SKIN_MM2)
    untrusted_percent: Limit = _limit(0.0, 60.0)
    warnings: Limit = _limit(0.0)
    motion_mm: Limit = _limit(None)
    identity_sigmas: Limit = _limit(2.0, 6.0)
    expression_sigmas: Limit = _limit(2.0, 6.0)
    offset_sigmas: Limit = _limit(1.0, 10.0)
    size_percent: Limit = _limit(15.0, 60.0)
    neutral_offsets_mm: Limit = _limit(1.5, 15.0)
    neutral_texture: Limit = _limit(0.5)
    sample_share: float = 0.05
    seed: int = 0
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.sample_share <= 1:
            raise self.invalid("sample_share", expected="a share from 0 to 1", got=self.sample_share)
        check_seed(self.seed)
        for name, limit in self.limits.items():
            if limit.look is not None and limit.reject is not None and limit.reject < limit.look:
                raise self.invalid(name, expected="a limit of rejection at or above that of a look", got=limit.reject)

    @property
    def limits(self) -> dict[str, Limit]:
        """Name of a figure -> its limit."""
        return {name: getattr(self, name) for name in FIGURES}

    @property
    def content_id(self) -> str:
        """sha256 of all that decides a verdict: of everything but the name and how the limits were found."""
        values = self.to_json()
        decisive = {name: value for name, value in values.items() if name not in ("name", "calibration")}
        return hashlib.sha256(json.dumps(decisive, sort_keys=True, allow_nan=False).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why a verdict is not `accept`."""

    level: Level
    text: str  # in plain words, without a full stop
    figure: str = ""  # its name; empty: no figure, but the status or missing evidence
    value: float | None = None
    limit: float | None = None
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The gate's verdict on one registration."""

    level: Level
    reasons: tuple[Reason, ...]  # the worst first
    unmeasured: tuple[str, ...]  # names of the figures that have a limit and no value
    sampled: bool = False  # accepted, and shown to a person nevertheless

    @property
    def for_person(self) -> bool:
        """Whether a person is to look at it."""
        return self.level == "look" or self.sampled

    @property
    def text(self) -> str:
        """The reasons in one line."""
        return "; ".join(reason.text for reason in self.reasons)


def judge(assessed: Assessed, thresholds: GateThresholds) -> Verdict:
    """Return the verdict on a registration: the worst level of all rules.

    A figure without a value neither accepts nor rejects; it is in `unmeasured`. What no figure measures at all
    (`EVIDENCE`) is a reason for a look.
    """
    reasons = [*_status(assessed, thresholds), *_exceeded(assessed.figures, thresholds)]
    known = assessed.figures.known()
    reasons += [
        Reason(level="look", text=f"nothing measures {what}")
        for what, names in EVIDENCE.items()
        if not any(name in known for name in names)
    ]
    ordered = tuple(sorted(reasons, key=_rank, reverse=True))
    level = ordered[0].level if ordered else LEVELS[0]
    return Verdict(
        level=level,
        reasons=ordered,
        unmeasured=_unmeasured(assessed, thresholds),
        sampled=level == "accept" and is_sampled(assessed.content_id, thresholds),
    )


def is_sampled(content_id: str, thresholds: GateThresholds) -> bool:
    """Return whether a person is shown this registration if it is accepted: the same choice in every run."""
    digest = hashlib.sha256(f"{thresholds.seed}:{content_id}".encode()).digest()
    return int.from_bytes(digest[:8], "big") < thresholds.sample_share * 2**64


def read_thresholds(file: Path | None, farm: Path | None = None) -> GateThresholds:
    """Return the thresholds in a file; if none is given, those of the farm, `FARM/gate/thresholds.json`; else defaults.

    Args:
        file: the file; None: none is given.
        farm: the farm's folder; None: there is no farm.

    Raises:
        InputError: the file cannot be read, or a value is out of range.
    """
    own = None if farm is None else Path(farm) / FOLDER / THRESHOLDS
    if file is None and own is not None and os.path.lexists(own):
        file = own
    return GateThresholds() if file is None else GateThresholds.read(Path(file))


def _status(assessed: Assessed, thresholds: GateThresholds) -> Sequence[Reason]:
    if assessed.status == "failed":
        return [Reason(level="reject", text=f"the registration failed: {assessed.reason}")]
    if assessed.status == "stopped" and thresholds.stopped != "accept":
        return [Reason(level=thresholds.stopped, text="the fit was stopped before the mesh came to rest")]
    return []


def _exceeded(figures: GateFigures, thresholds: GateThresholds) -> list[Reason]:
    reasons = []
    for name, value in figures.known().items():
        limit: Limit = getattr(thresholds, name)
        if (level := limit.level(value)) == "accept":
            continue
        kind, bound = FIGURES[name], limit.reject if level == "reject" else limit.look
        assert bound is not None
        text = f"{kind.title} {kind.text(value)} (limit {kind.text(bound)})"
        reasons.append(Reason(level=level, text=text, figure=name, value=value, limit=bound, unit=kind.unit))
    return reasons


def _rank(reason: Reason) -> tuple[int, float]:
    exceeded = (reason.value or 0) / reason.limit if reason.limit else 1.0
    return LEVELS.index(reason.level), exceeded


def _unmeasured(assessed: Assessed, thresholds: GateThresholds) -> tuple[str, ...]:
    """Figures with a limit and without a value, but for those that a neutral cannot have."""
    known = assessed.figures.known()
    unused = [name for name, limit in thresholds.limits.items() if limit == Limit()]
    impossible = ("neutral_offsets_mm", "neutral_texture") if assessed.is_neutral else ()
    names = (item.name for item in fields(GateFigures))
    return tuple(name for name in names if name not in (*known, *unused, *impossible))
