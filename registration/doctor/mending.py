"""Write a mended copy of a capture: what has one mend is mended, what has several is left to a person."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from registration.capture.native_writer import check_new
from registration.doctor.diagnosis import Diagnosis, diagnose
from registration.doctor.findings import Finding
from registration.errors import InputError
from registration.storage.files import atomic_directory

RECORD = "doctor.txt"
_MAX_ROUNDS = 6  # a mend may uncover another fault


@dataclass(frozen=True, kw_only=True)
class MendedCapture:
    """What was done to a copy of a capture, and what is left to do."""

    source: Path
    out: Path | None  # None: nothing could be mended, and nothing was written
    done: tuple[Finding, ...]
    left: Diagnosis  # of the copy, or of the source without one; paths are the copy's

    @property
    def usable(self) -> bool:
        """Whether a registration would take the result."""
        return not self.left.errors

    def __str__(self) -> str:
        """The record, as in the file of the copy."""
        if self.out is None:
            end = "Nothing is wrong that has one mend only." if self.left.findings else "Nothing is wrong."
            return "\n\n".join([f"{self.source}: nothing was written. {end}", *_lines(self.left)])
        lines = [f"{self.out}: a copy of {self.source} with {len(self.done)} mends"]
        for finding in self.done:
            assert finding.fix is not None
            lines.append(
                f"mended: {finding.believed} ({finding.kind})\n  found: {finding.evidence or finding.mend}\n"
                f"  done:  {finding.fix.what}"
            )
        left = _lines(self.left) or ["Nothing is left to do."]
        return "\n\n".join([*lines, *left])


def mend_capture(source: Path, out: Path, diagnosis: Diagnosis | None = None) -> MendedCapture:
    """Write a copy of a capture with all mends that are certain, and the record `doctor.txt`; it is checked again.

    Args:
        source: the capture folder; it is not changed.
        out: the copy, which appears in one rename; it must not exist. Without any mend nothing is written.
        diagnosis: of the source; None: it is made here.

    Raises:
        InputError: `out` exists, or the source is no folder.
    """
    source, out = Path(source), Path(out)
    check_new(out)
    diagnosis = diagnosis or diagnose(source)
    if not diagnosis.mendable:
        return MendedCapture(source=source, out=None, done=(), left=diagnosis)
    done: list[Finding] = []
    with atomic_directory(out) as temporary:
        shutil.copytree(source, temporary, dirs_exist_ok=True, copy_function=shutil.copyfile, symlinks=True)
        for _ in range(_MAX_ROUNDS):
            before = len(done)
            for finding in diagnosis.mendable:
                if not _is_done(finding, done) and _mended(finding, temporary):
                    done.append(finding)
            if len(done) == before:
                break
            diagnosis = diagnose(temporary)
        moved = tuple(finding.moved(temporary, out) for finding in diagnosis.findings)
        left = replace(diagnosis, root=out, findings=moved)
        mended = MendedCapture(
            source=source, out=out, done=tuple(finding.moved(temporary, out) for finding in done), left=left
        )
        (temporary / RECORD).write_text(f"{mended}\n", "utf-8")
    return mended


def _is_done(finding: Finding, done: list[Finding]) -> bool:
    """Whether the same mend was made before: it does not help, and is left to a person."""
    what = finding.fix and finding.fix.what
    return any(other.kind == finding.kind and other.fix is not None and other.fix.what == what for other in done)


def _mended(finding: Finding, root: Path) -> bool:
    """Mend a folder; False: something else keeps its files from being read."""
    assert finding.fix is not None
    try:
        finding.fix.on_folder(root)
    except InputError:
        return False
    return True


def _lines(diagnosis: Diagnosis) -> list[str]:
    lines = [f"left: {finding.error}" for finding in diagnosis.errors]
    warned = [f"left: warning: {finding.line}" for finding in diagnosis.findings if finding.severity == "warning"]
    return [*lines, *(["\n".join(warned)] if warned else [])]
