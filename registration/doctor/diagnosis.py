"""All findings of a capture at once, errors first."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from registration.doctor.examination import Examination
from registration.doctor.findings import Finding
from registration.doctor.ledger import Ledger
from registration.doctor.lenient import read_leniently
from registration.types import Capture


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What the checks found."""

    root: Path
    findings: tuple[Finding, ...]  # errors first
    as_written: Capture | None  # before mends of poses, K and unit; None: it cannot be read
    capture: Capture | None  # as it would be with the mends of the errors; None: it cannot be read
    ledger: Ledger | None  # None: the checks ended early

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings for which a registration is refused."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def mendable(self) -> tuple[Finding, ...]:
        """The findings that `--fix` mends."""
        return tuple(finding for finding in self.findings if finding.fix is not None)

    def __str__(self) -> str:
        """The errors, each with its mend."""
        text = "\n\n".join(str(finding.error) for finding in self.errors)
        if self.errors and self.ledger is None:
            text += "\n\nThe checks ended here: mend this first, then check again."
        return text


def diagnose(root: Path) -> Diagnosis:
    """Check a native capture folder and go on after an error, as if it were mended, where the mend is known.

    Args:
        root: the capture folder; nothing is written.
    """
    reading = read_leniently(Path(root))
    findings, capture, ledger = list(reading.findings), reading.capture, None
    as_written = capture
    if capture is not None:
        examination = Examination(capture)
        findings += examination.findings
        capture, ledger = examination.capture, examination.ledger
    errors = [finding for finding in findings if finding.severity == "error"]
    others = [finding for finding in findings if finding.severity != "error"]
    return Diagnosis(
        root=Path(root), findings=(*_merged(errors), *others), as_written=as_written, capture=capture, ledger=ledger
    )


def _merged(errors: Iterable[Finding]) -> list[Finding]:
    """One finding for files that have the same fault."""
    groups: dict[tuple[str, str, str], list[Finding]] = {}
    for finding in errors:
        groups.setdefault((finding.kind, finding.believed, finding.mend), []).append(finding)
    merged = []
    for group in groups.values():
        first = group[0]
        more = f"{first.evidence}; and {len(group) - 1} more, as {Path(group[-1].where).name}"
        merged.append(first if len(group) == 1 or first.fix is not None else replace(first, evidence=more))
        merged += group[1:] if first.fix is not None else []
    return merged
