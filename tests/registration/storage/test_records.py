"""Records: what is written is read back equal; each kind of defect is an error that names the file and the field."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from registration.errors import InputError
from registration.storage.records import Record, json_key, structure


@dataclass(frozen=True, kw_only=True)
class Row:
    name: str
    status: Literal["converged", "failed"] = "converged"
    seconds: float | None = None
    size: tuple[int, int] = (4, 3)
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Example(Record, kind="gnm-example", schema=2, title="example's record", fix="run `gnmreg example` again"):
    subject: str
    neutral: bool
    count: int
    model: Path
    rows: tuple[Row, ...] = json_key("captures")
    labels: Sequence[str] = ()
    errors_mm: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    at: int | str | None = None


@dataclass(frozen=True, kw_only=True)
class Bare(Record, title="line"):
    action: str


def example() -> Example:
    rows = (Row(name="a", seconds=1.5, figures={"face": {"mean_mm": 0.1}}), Row(name="b", status="failed"))
    return Example(
        subject="ada",
        neutral=True,
        count=3,
        model=Path("/models/first.npz"),
        rows=rows,
        labels=("smile",),
        errors_mm={"face": {"median": 0.25}},
        at="last",
    )


def test_records_are_read_back_equal(tmp_path):
    example().write(tmp_path / "record.json")
    assert Example.read(tmp_path / "record.json") == example()
    assert Example.is_ours(tmp_path / "record.json") and not Example.is_ours(tmp_path / "other.json")
    assert [path.name for path in tmp_path.iterdir()] == ["record.json"]


def test_the_file_has_kind_and_schema_first_then_the_keys_of_the_declaration():
    value = json.loads(example().to_text())
    keys = ["kind", "schema", "subject", "neutral", "count", "model", "captures", "labels", "errors_mm", "at"]
    assert list(value) == keys
    assert value["kind"] == "gnm-example" and value["schema"] == 2
    assert list(value["captures"][0]) == ["name", "status", "seconds", "size", "figures"]


def test_non_finite_numbers_are_null_and_whole_numbers_are_numbers():
    record = Example.from_json({**valid(), "captures": [{"name": "a", "seconds": 2}]}, where="record.json")
    assert record.rows[0].seconds == 2.0 and isinstance(record.rows[0].seconds, float)
    written = json.loads(text_with_seconds(float("nan")))
    assert written["captures"][0]["seconds"] is None


def text_with_seconds(seconds: float) -> str:
    fields = {name: getattr(example(), name) for name in ("subject", "neutral", "count", "model")}
    return Example(**fields, rows=(Row(name="a", seconds=seconds),)).to_text()


def test_a_record_without_a_kind_has_neither_kind_nor_schema():
    assert json.loads(Bare(action="keep").to_text()) == {"action": "keep"}
    assert Bare.from_text('{"action": "keep"}', where="log, line 1") == Bare(action="keep")


def valid() -> dict[str, Any]:
    return json.loads(example().to_text())


def changed(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda value: value.update(changes)


def without(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda value: value.pop(key)


def in_row(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda value: value["captures"][1].update(changes)


DEFECTS = {  # case -> the change, the field that the message names, what it expects, what it got
    "foreign": (changed(kind="browser extension"), "", '"kind": "gnm-example"', '"browser extension"'),
    "no kind": (without("kind"), "", '"kind": "gnm-example"', "null"),
    "newer schema": (changed(schema=3), "schema", "2", "3"),
    "older schema": (changed(schema=1), "schema", "2", "1"),
    "schema is text": (changed(schema="2"), "schema", "2", '"2"'),
    "missing": (without("subject"), "subject", "this field", "no such field"),
    "unknown": (changed(colour="red"), "colour", "no such field", "an unknown field"),
    "number for text": (changed(subject=3), "subject", "a string", "3"),
    "text for number": (changed(count="3"), "count", "a whole number", '"3"'),
    "fraction for whole": (changed(count=3.5), "count", "a whole number", "3.5"),
    "true for number": (changed(count=True), "count", "a whole number", "true"),
    "number for true": (changed(neutral=1), "neutral", "true or false", "1"),
    "no union member": (changed(at=[1]), "at", "int | str | None", "[1]"),
    "text for list": (changed(labels="smile"), "labels", "a list", '"smile"'),
    "in a list": (changed(labels=["smile", 3]), "labels[1]", "a string", "3"),
    "list for object": (changed(errors_mm=[]), "errors_mm", "an object", "[]"),
    "in an object": (changed(errors_mm={"face": {"p95": "x"}}), "errors_mm['face']['p95']", "a number", '"x"'),
    "row is no object": (changed(captures=[3]), "captures[0]", "an object", "3"),
    "row's literal": (in_row(status="lost"), "captures[1].status", 'one of "converged", "failed"', '"lost"'),
    "row's optional": (in_row(seconds="1"), "captures[1].seconds", "a number", '"1"'),
    "row's length": (in_row(size=[4]), "captures[1].size", "a list of 2", "[4]"),
    "row's unknown": (in_row(colour="red"), "captures[1].colour", "no such field", "an unknown field"),
}


@pytest.mark.parametrize("case", DEFECTS)
def test_a_defect_is_named_with_file_field_and_both_values(tmp_path, case):
    change, key, expected, got = DEFECTS[case]
    value = valid()
    change(value)
    file = tmp_path / "record.json"
    file.write_text(json.dumps(value))
    with pytest.raises(InputError, match="example's record") as caught:
        Example.read(file)
    error = caught.value
    assert str(file) in error.where and (not key or f"field {key!r}" in error.where)
    assert (error.expected, error.got) == (expected, got)
    assert error.fix


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"null", b'{"kind": NaN}', b"\xff\xfe", b"[" * 100_000])
def test_a_file_that_is_no_json_object_is_named(tmp_path, content):
    file = tmp_path / "record.json"
    file.write_bytes(content)
    with pytest.raises(InputError, match="a JSON object|a text file in UTF-8|64 levels") as caught:
        Example.read(file)
    assert caught.value.where == str(file) and not Example.is_ours(file)


@pytest.mark.parametrize("make", [lambda file: None, lambda file: file.mkdir()])
def test_a_missing_file_is_named(tmp_path, make):
    make(tmp_path / "record.json")
    with pytest.raises(InputError, match="a readable file|a regular file") as caught:
        Example.read(tmp_path / "record.json")
    assert caught.value.where == str(tmp_path / "record.json")


def test_any_type_of_a_field_can_be_structured_alone():
    assert structure({"a": [1, None]}, Mapping[str, list[float | None]], where="history.json") == {"a": [1.0, None]}
    with pytest.raises(InputError, match=r"\['a'\]\[1\]"):
        structure({"a": [1, "x"]}, Mapping[str, list[float | None]], where="history.json")
