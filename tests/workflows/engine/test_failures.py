"""Failures of one kind are one, whatever their paths and numbers are."""

import pytest

from workflows.engine.failures import failure_kinds, general, kind_of
from workflows.engine.reader import JobTimes


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("FileNotFoundError: '/data/ann/a.png'", "FileNotFoundError: '/data/bob cat/b.png'"),
        ("no such file: /data/ann/a.png", "no such file: s3://bucket/bob/b.png"),
        ("took 3.5 s at 0x7f00", "took 1e-3 s at 0xdead"),
        ("OSError: [Errno 28] No space left on device: '/a'", "OSError: [Errno 28] No space left on device: '/b/c'"),
    ],
)
def test_paths_names_and_numbers_do_not_count(first: str, second: str) -> None:
    assert general(first) == general(second)


@pytest.mark.parametrize(
    ("first", "second"),
    [("ValueError: negative", "TypeError: negative"), ("landmarks are off", "the views disagree")],
)
def test_other_reasons_are_other_kinds(first: str, second: str) -> None:
    assert general(first) != general(second)


def row(name: str, **failure: str) -> JobTimes:
    return JobTimes(name, "job", "failed", "w", 2.0, 1.0, "wf", "gpu", 0.0, 0.0, True, True, failure)


def test_failures_are_grouped_with_the_fix_of_the_first() -> None:
    missing = [
        row(f"r/{n}", status="bad input", what="The mask is empty", reason=f"The mask is empty: /d/{n}", fix="draw it")
        for n in range(3)
    ]
    kinds = failure_kinds([row("r/x", status="died", reason="its process was killed by SIGKILL"), *missing])
    assert [(kind.kind, kind.jobs) for kind in kinds] == [
        ("bad input: The mask is empty", ("r/0", "r/1", "r/2")),
        ("died: its process was killed by SIGKILL", ("r/x",)),
    ]
    assert (kinds[0].reason, kinds[0].fix) == ("The mask is empty: /d/0", "draw it")


def test_records_of_any_form_have_a_kind() -> None:
    assert kind_of({}) == "None: " and kind_of({"status": 3, "what": 4, "reason": None}) == "3: None"
