"""Jobs, locations and ids from a queue or a store that others can write to are checked."""

import json
from pathlib import Path

import pytest

from registration.errors import InputError
from workflows.engine.jobs import MAX_BYTES, Step, validate_arguments
from workflows.ids import check_id, check_location, redact, resolve_roots

STEPS = {"register": Step(function="m:f", path_arguments=("capture", "out"))}


def test_a_job_within_the_roots_is_accepted(tmp_path: Path) -> None:
    roots = resolve_roots((tmp_path, "s3://bucket/runs"))
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    opened = {"s3://bucket/runs/a": "s3://bucket/runs/a", str(tmp_path): str(tmp_path)}
    for form in ("{}/a", "//{}/a/", "{}/a/../a", "{}/link", "file://{}/a", "file:{}/a", "FILE://localhost{}/%61"):
        opened[form.format(tmp_path)] = f"{tmp_path}/a"
    for location, place in opened.items():
        arguments = {"capture": location, "out": None, "seed": 3}
        step, got = validate_arguments({"step": "register", "arguments": arguments}, STEPS, roots)
        assert (step.function, got) == ("m:f", {**arguments, "capture": place}), location


def test_lists_and_objects_of_locations_are_checked_to_the_last(tmp_path: Path) -> None:
    roots = resolve_roots((tmp_path,))
    for value in ({"a": [f"{tmp_path}/x", f"{tmp_path}/y/../z"]}, [f"{tmp_path}/x"]):
        validate_arguments({"step": "register", "arguments": {"capture": value}}, STEPS, roots)
    for value in ({"a": ["/etc"]}, [[f"{tmp_path}/x", None]], {"a": {"b": 5}}):
        with pytest.raises(InputError):
            validate_arguments({"step": "register", "arguments": {"capture": value}}, STEPS, roots)


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
def test_a_malformed_job_is_refused(spec: object, expected: str) -> None:
    with pytest.raises(InputError) as refused:
        validate_arguments(spec, STEPS, ("/",))
    assert expected in refused.value.expected


@pytest.mark.parametrize(
    "location",
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
        "file://{root}/link/x",
        "file:/etc/passwd",
        "file://localhost/etc/passwd",
        "file://{root}/%2e%2e%2fother",
        "file://{root}?/../../etc/passwd",
        "file://{root}#/../../etc/passwd",
        "file:///etc/passwd?{root}",
        "file:{root}/../other",
        "file://otherhost{root}/x",
        "file://user:secret@host{root}/x",
        "FILE:///etc/passwd",
        "local:///etc/passwd",
        "simplecache::file:///etc/passwd",
        "~/x",
        " file:///etc",
        "s3://bucket/runs?versionId=1",
        "s3://bucket/runs#x",
        "s3://bucket/runs/./../x",
        "s3://bucket/runs-beside",
        "s3://key:se/cret@bucket/runs",
        "s3://bucket\n/runs/x",
        "s3:///runs",
        "{root}/\ud800",
        "file://",
    ],
)
def test_a_location_outside_the_roots_is_refused(tmp_path: Path, location: object) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "other").mkdir()
    (root / "link").symlink_to(tmp_path / "other")
    location = location.format(root=root) if isinstance(location, str) else location
    with pytest.raises(InputError) as refused:
        validate_arguments(
            {"step": "register", "arguments": {"capture": location}}, STEPS, resolve_roots((root, "s3://bucket/runs"))
        )
    assert "secret" not in str(refused.value).replace("secrets", "")


def test_without_roots_no_location_is_accepted(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        check_location(str(tmp_path), (), "capture")


@pytest.mark.parametrize(
    "identity", ["", "a/../b", "../a", "/a", "a/", "a//b", ".a", "a b", "a\n", "a/" * 9 + "a", "ä"]
)
def test_ids_that_are_no_relative_paths_are_refused(identity: str) -> None:
    with pytest.raises(InputError):
        check_id(identity)


def test_a_valid_id_is_accepted() -> None:
    assert check_id("run-1/it00/s0007/e03") == "run-1/it00/s0007/e03"


def test_passwords_are_redacted() -> None:
    text = json.dumps(
        {"a": "postgresql+psycopg://me:pass@h/db", "b": "x postgresql://me:word@h/db?x=1", "c": "s3://b/k"}
    )
    assert "word" not in redact(text) and "pass" not in redact(text)
    assert "s3://b/k" in redact(text)
