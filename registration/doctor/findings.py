"""What the checks of a capture find: the refusal, the report of `gnmreg capture check` and `--fix` share one type."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from registration.capture.samples import ViewSample
from registration.errors import InputError
from registration.types import Camera, Capture

MENDING = "`gnmreg capture check CAPTURE --fix OUT` writes a copy with this mended"


@runtime_checkable
class Fix(Protocol):
    """The one mend of a finding, in memory and on disk."""

    @property
    def what(self) -> str:
        """What it does, for the record of a mended capture."""

    def on_capture(self, capture: Capture) -> Capture:
        """The capture as it would be read after the mend, so that later checks can go on; files stay as they are."""

    def on_sample(self, sample: ViewSample, camera: Camera) -> ViewSample:
        """The same for what was decoded of a view."""

    def on_folder(self, root: Path) -> None:
        """Mend a native capture folder in place."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is, or may be, wrong with a capture."""

    kind: str  # one of `docs/doctor.md`
    severity: Literal["error", "warning"]  # an error refuses a registration
    where: str  # file, folder or view
    believed: str  # what is wrong
    expected: str
    evidence: str  # what was found instead
    mend: str  # the edit or option that mends it
    fix: Fix | None = None  # None: there are several mends, or a person must decide

    @classmethod
    def of_error(cls, error: InputError, kind: str = "unreadable", fix: Fix | None = None) -> "Finding":
        """The finding that an error carries; another error becomes one of this kind."""
        if isinstance(error, FindingError):
            return error.finding
        return cls(
            kind=kind,
            severity="error",
            where=error.where,
            believed=error.what,
            expected=error.expected,
            evidence=error.got,
            mend=error.fix,
            fix=fix,
        )

    @classmethod
    def warning(cls, kind: str, line: str, fix: Fix | None = None) -> "Finding":
        """A warning of one line: what is believed, and after a semicolon what mends it."""
        believed, _, mend = line.rpartition("; ")
        return cls(
            kind=kind,
            severity="warning",
            where="",
            believed=believed or mend,
            expected="",
            evidence="",
            mend=mend if believed else "",
            fix=fix,
        )

    @property
    def line(self) -> str:
        """In one line: a warning as reports list it, an error with its mend."""
        parts = [f"{self.where}: {self.believed}" if self.where else self.believed, self.evidence, self.mend]
        return "; ".join(part for part in parts if part)

    def moved(self, source: Path, target: Path) -> "Finding":
        """The finding about the same capture in another folder."""
        return replace(self, where=self.where.replace(str(source), str(target)))

    @property
    def error(self) -> "FindingError":
        """The refusal."""
        return FindingError(self)


class FindingError(InputError):
    """The refusal of a capture for one finding."""

    def __init__(self, finding: Finding):
        fix = f"{finding.mend}; {MENDING}" if finding.fix is not None else finding.mend
        super().__init__(
            finding.believed, where=finding.where, expected=finding.expected, got=finding.evidence, fix=fix
        )
        self.finding = finding


def refuse(
    kind: str, what: str, *, where: object, expected: object, got: object, fix: str, mend: Fix | None = None
) -> FindingError:
    """An `InputError` with the kind of what was found, and with the mend if there is one only."""
    finding = Finding(
        kind=kind,
        severity="error",
        where=str(where),
        believed=what,
        expected=str(expected),
        evidence=str(got),
        mend=fix,
        fix=mend,
    )
    return finding.error


def warnings(kind: str, lines: Iterable[str]) -> list[Finding]:
    """Lines of one check as warnings."""
    return [Finding.warning(kind, line) for line in lines]
