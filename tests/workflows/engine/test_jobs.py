"""What comes out of a queue, or out of a store, that others can write to: refused with a clear error."""

import json
from pathlib import Path

import pytest

from registration.errors import InputError
from workflows.engine.jobs import MAX_BYTES, Step, validate_arguments
from workflows.ids import check_id, check_location, redact, resolve_roots

STEPS = {"register": Step(function="m:f", path_arguments=("capture", "out"))}


def test_a_job_within_the_roots_is_accepted(tmp_path: Path) -> None:
    roots = resolve_roots((tmp_path, "s3://bucket/runs"))
    for place in (str(tmp_path / "a"), f"file://{tmp_path}/a", "s3://bucket/runs/a", str(tmp_path)):
        arguments = {"capture": place, "seed": 3}
        step, got = validate_arguments({"step": "register", "arguments": arguments}, STEPS, roots)
        assert (step.function, got) == ("m:f", arguments)


@pytest.mark.parametrize(
    "spec, expected",
    [
        ({"step": "os:system", "arguments": {}}, "one of register"),
        ({"step": ["register"], "arguments": {}}, "one of register"),
        ({"step": "register"}, "an object of step and arguments"),
        ({"step": "register", "arguments": {}, "function": "os:system"}, "an object of step and arguments"),
        ("register", "an object of step and arguments"),
        (None, "an object of step and arguments"),
        ({"step": "register", "arguments": ["x"]}, "an object of arguments"),
        ({"step": "register", "arguments": {"note": "x" * MAX_BYTES}}, f"at most {MAX_BYTES} bytes"),
    ],
)
def test_a_job_of_another_form_is_refused(spec: object, expected: str) -> None:
    with pytest.raises(InputError) as refused:
        validate_arguments(spec, STEPS, ("/",))
    assert expected in refused.value.expected


@pytest.mark.parametrize(
    "place",
    [
        "/etc/passwd",
        "{root}/../other/x",
        "{root}/a/../../other",
        "{root}-beside/x",
        "file://{root}/%2e%2e/other",
        "s3://other/runs/x",
        "s3://bucket/runs/../secrets",
        "s3://key:secret@bucket/runs/x",
        "http://169.254.169.254/latest",
        "ftp://host/x",
        "",
        "{root}/\0x",
        7,
        ["/etc/passwd"],
        "{root}/link/x",
    ],
)
def test_a_foreign_place_is_refused(tmp_path: Path, place: object) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "other").mkdir()
    (root / "link").symlink_to(tmp_path / "other")
    place = place.format(root=root) if isinstance(place, str) else place
    with pytest.raises(InputError) as refused:
        validate_arguments(
            {"step": "register", "arguments": {"capture": place}}, STEPS, resolve_roots((root, "s3://bucket/runs"))
        )
    assert "secret" not in str(refused.value).replace("secrets", "")


def test_without_roots_no_place_is_accepted(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        check_location(str(tmp_path), (), "capture")


@pytest.mark.parametrize(
    "identity", ["", "a/../b", "../a", "/a", "a/", "a//b", ".a", "a b", "a\n", "a/" * 9 + "a", "ä"]
)
def test_ids_that_would_be_no_paths_are_refused(identity: str) -> None:
    with pytest.raises(InputError):
        check_id(identity)


def test_ids_of_the_pattern_are_accepted() -> None:
    assert check_id("run-1/it00/s0007/e03") == "run-1/it00/s0007/e03"


def test_passwords_do_not_show() -> None:
    text = json.dumps(
        {"a": "postgresql+psycopg://me:pass@h/db", "b": "x postgresql://me:word@h/db?x=1", "c": "s3://b/k"}
    )
    assert "word" not in redact(text) and "pass" not in redact(text)
    assert "s3://b/k" in redact(text)
