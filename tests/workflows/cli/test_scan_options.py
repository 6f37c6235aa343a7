"""Combinations of a capture, a scan and the scan's options."""

from pathlib import Path

import pytest

from registration.errors import InputError
from workflows.cli.scan_options import ScanOptions

SCAN = Path("scan.obj")


def test_a_capture_or_a_scan() -> None:
    ScanOptions().check(Path("capture"))
    ScanOptions(scan=SCAN, scan_landmarks="points.pp", unit="mm").check(None)


@pytest.mark.parametrize(
    ("options", "capture", "got"),
    [
        (ScanOptions(), None, "neither"),
        (ScanOptions(scan=SCAN), Path("capture"), "both"),
        (ScanOptions(unit="mm"), Path("capture"), "a capture folder"),
        (ScanOptions(scan_landmarks="a.pp"), Path("capture"), "a capture folder"),
    ],
)
def test_other_combinations_are_refused(options: ScanOptions, capture: Path | None, got: str) -> None:
    with pytest.raises(InputError) as error:
        options.check(capture)
    assert error.value.got == got
