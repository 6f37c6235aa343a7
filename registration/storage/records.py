"""Typed JSON records on disk: one frozen dataclass declares the kind, the schema version and the fields of a file.

    @dataclass(frozen=True, kw_only=True)
    class SubjectRecord(Record, kind="gnm-subject", title="subject's record"):
        subject: str
        rows: tuple[CaptureRow, ...] = json_key("captures")  # the key on disk, where it differs from the field's name

    SubjectRecord(subject="ada", rows=()).write(folder / "subject.json")
    record = SubjectRecord.read(folder / "subject.json")

The file is a JSON object with "kind", "schema" and the fields. Fields may be str, bool, int, float, Path, Literal,
None, Any, unions of these, tuples and sequences, mappings with str keys, and dataclasses. Reading is strict: no type is
converted to another, except an int where a float is declared; unknown keys are refused in the record and in dataclasses
within it. Non-finite floats are written as `null`: declare `float | None` where they may occur.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin

from cattrs import (
    AttributeValidationNote,
    ClassValidationError,
    Converter,
    ForbiddenExtraKeysError,
    IterableValidationError,
)
from cattrs.cols import (
    homogenous_tuple_structure_factory,
    is_mapping,
    is_sequence,
    list_structure_factory,
    mapping_structure_factory,
)
from cattrs.gen import make_dict_structure_fn, override

from registration.errors import InputError
from registration.storage import reading
from registration.storage.files import atomic_write_text, has_kind, json_text
from registration.storage.jsonable import to_jsonable

R = TypeVar("R", bound="Record")
Hook = Callable[[Any, Any], Any]  # of cattrs: (value, type) -> the structured value
_KEY = "json_key"


def json_key(key: str, **options: Any) -> Any:
    """Declare a dataclass field that has another name on disk; `options` are those of `dataclasses.field`."""
    return field(metadata={_KEY: key}, **options)


@dataclass(frozen=True, kw_only=True)
class Record:
    """Base of the records. Subclasses are frozen dataclasses that are declared with class arguments.

    Class arguments:
        kind: the value of "kind" on disk; empty: the file has neither "kind" nor "schema".
        schema: the schema version that this code writes and reads.
        title: what messages call it, after "The".
        fix: how a user gets a valid one, for messages.
    """

    KIND: ClassVar[str] = ""
    SCHEMA: ClassVar[int] = 1
    TITLE: ClassVar[str] = "record"
    FIX: ClassVar[str] = "correct the file, or write it again"

    def __init_subclass__(
        cls, kind: str | None = None, schema: int | None = None, title: str | None = None, fix: str | None = None
    ) -> None:
        declared = {"KIND": kind, "SCHEMA": schema, "TITLE": title, "FIX": fix}
        for name, value in declared.items():
            if value is not None:
                setattr(cls, name, value)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object: "kind" and "schema", then the fields in the order of their declaration."""
        head: dict[str, Any] = {"kind": self.KIND, "schema": self.SCHEMA} if self.KIND else {}
        return head | to_json(self)

    def to_text(self) -> str:
        """Return the text of the file."""
        return json_text(self.to_json())

    def write(self, file: Path) -> None:
        """Write the file in one rename. Its folder must exist."""
        atomic_write_text(file, self.to_text())

    @classmethod
    def read(cls: type[R], file: Path) -> R:
        """Read a file that `write` wrote.

        Raises:
            InputError: there is no such file, it is no JSON object, of another kind or of another schema version, or a
                field is missing, unknown or of a wrong type. The message names the file and the field.
        """
        return cls.from_json(read_json(file, title=cls.TITLE, fix=cls.FIX), where=file)

    @classmethod
    def from_text(cls: type[R], content: str | bytes, *, where: object) -> R:
        """Read a record from the content of its file. `where` names the file in messages. Raises as `read`."""
        return cls.from_json(reading.parse_json(content, partial(cls.invalid, where)), where=where)

    @classmethod
    def from_json(cls: type[R], value: Any, *, where: object) -> R:
        """Read a record from a JSON value. `where` names its file in messages. Raises as `read`."""
        if not isinstance(value, Mapping):
            raise cls.invalid(where, expected="a JSON object", got=_shown(value))
        if cls.KIND:
            cls._check_head(value, where)
            value = {key: item for key, item in value.items() if key not in ("kind", "schema")}
        return structure(value, cls, where=where, title=cls.TITLE, fix=cls.FIX)

    @classmethod
    def is_ours(cls, file: Path) -> bool:
        """Return whether the file is a record of this kind, of any schema version and possibly with invalid fields."""
        return has_kind(file, cls.KIND)

    @classmethod
    def invalid(cls, where: object, *, expected: object, got: object) -> InputError:
        """Return the error for a record that cannot be read, also for checks that types cannot express."""
        return InputError.unreadable(cls.TITLE, where=where, expected=expected, got=got, fix=cls.FIX)

    @classmethod
    def _check_head(cls, value: Mapping[str, Any], where: object) -> None:
        if value.get("kind") != cls.KIND:
            raise cls.invalid(where, expected=f'"kind": "{cls.KIND}"', got=_shown(value.get("kind")))
        schema = value.get("schema")
        if schema != cls.SCHEMA or isinstance(schema, bool):
            newer = isinstance(schema, int) and schema > cls.SCHEMA
            raise InputError(
                f"The {cls.TITLE} has {'a newer' if newer else 'another'} schema version",
                where=f"{where}, field 'schema'",
                expected=cls.SCHEMA,
                got=_shown(schema),
                fix="read it with the version of gnmreg that wrote it" + (", or update gnmreg" if newer else ""),
            )


def read_json(file: Path, *, title: str = "record", fix: str = Record.FIX) -> Any:
    """Read the value in a JSON file.

    Raises:
        InputError: as `reading.read_json`.
    """
    return reading.read_json(Path(file), partial(InputError.unreadable, title, where=file, fix=fix))


def structure(value: Any, type_: Any, *, where: object, title: str = "record", fix: str = Record.FIX) -> Any:
    """Convert a JSON value to a type, strictly (module docstring).

    Args:
        value: as `json.loads` returns it.
        type_: a dataclass, or any other type that a record's field may have.
        where: names the file in messages.
        title: what messages call the value, after "The".
        fix: how a user gets a valid one.

    Raises:
        InputError: the value does not have this type. Names the first offending field.
    """
    try:
        return _CONVERTER.structure(value, type_)
    except Exception as error:  # cattrs raises groups of errors, in which ours are leaves
        path, leaf = _first_leaf(error)
        if isinstance(leaf, InputError):  # a dataclass refuses its values itself
            raise leaf from None
        mismatch = _as_mismatch(leaf)
        if mismatch is None:
            raise
        path += mismatch.path
        place = f"{where}, field {path.lstrip('.')!r}" if path else where
        raise InputError.unreadable(title, where=place, expected=mismatch.expected, got=mismatch.got, fix=fix) from None


class _MismatchError(Exception):
    """A value is not what its type says."""

    def __init__(self, expected: str, got: str, path: str = "") -> None:
        super().__init__(expected, got)
        self.expected, self.got, self.path = expected, got, path


def _first_leaf(error: BaseException, path: str = "") -> tuple[str, BaseException]:
    """The first error that is no group, and the path of its field: `captures[3].status`."""
    if not isinstance(error, ClassValidationError | IterableValidationError):
        return path, error
    noted, others = error.group_exceptions()
    if not noted:
        return _first_leaf(others[0], path)
    inner, note = noted[0]
    if isinstance(error, ClassValidationError) and isinstance(note, AttributeValidationNote):
        keys = {f.name: f.metadata.get(_KEY, f.name) for f in fields(error.cl)}
        return _first_leaf(inner, f"{path}.{keys[note.name]}")
    return _first_leaf(inner, f"{path}[{getattr(note, 'index', None)!r}]")


def _as_mismatch(error: BaseException) -> _MismatchError | None:
    if isinstance(error, _MismatchError):
        return error
    if isinstance(error, ForbiddenExtraKeysError):
        return _MismatchError("no such field", "an unknown field", f".{min(error.extra_fields)}")
    if isinstance(error, KeyError):
        return _MismatchError("this field", "no such field")
    return None


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else f"{text[:57]}..."


def to_json(value: Any) -> Any:
    """Return JSON values as `to_jsonable`, but of dataclasses their fields alone, with the keys of `json_key`."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.metadata.get(_KEY, f.name): to_json(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    return to_jsonable(value)


def _strict(expected: str, valid: Callable[[Any], bool], convert: Callable[[Any], Any]) -> Hook:
    def structure_value(value: Any, _: Any) -> Any:
        if not valid(value):
            raise _MismatchError(expected, _shown(value))
        return convert(value)

    return structure_value


def _exactly(type_: type, expected: str) -> Hook:
    return _strict(expected, lambda value: type(value) is type_, lambda value: value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple)


def _is_object(value: Any) -> bool:
    return isinstance(value, Mapping)


def _literal_hook(type_: Any, _: Converter) -> Hook:
    allowed = get_args(type_)
    expected = "one of " + ", ".join(_shown(item) for item in allowed)
    return _strict(expected, lambda v: any(v == a and type(v) is type(a) for a in allowed), lambda v: v)


def _union_hook(type_: Any, converter: Converter) -> Hook:
    """The first member that the value fits; with one member beside None, that member's own error."""
    members = [item for item in get_args(type_) if item is not type(None)]
    hooks = [(converter.get_structure_hook(item), item) for item in members]

    def structure_union(value: Any, _: Any) -> Any:
        if value is None and type(None) in get_args(type_):
            return None
        for hook, member in hooks:
            try:
                return hook(value, member)
            except Exception:
                if len(hooks) == 1:
                    raise
        raise _MismatchError(str(type_), _shown(value))

    return structure_union


def _sequence_hook(type_: Any, converter: Converter) -> Hook:
    """Lists for `list`, tuples for abstract sequences: a record is immutable as far as its types allow."""
    inner = list_structure_factory(type_, converter)
    to_type = list if (get_origin(type_) or type_) is list else tuple
    return _strict("a list", _is_list, lambda value: to_type(inner(value, type_)))


def _tuple_hook(type_: Any, converter: Converter) -> Hook:
    members = get_args(type_)
    if not members or members[-1] is Ellipsis:
        inner = homogenous_tuple_structure_factory(type_, converter)
        return _strict("a list", _is_list, lambda value: inner(value, type_))
    fixed = converter.gen_structure_hetero_tuple(type_)
    expected = f"a list of {len(members)}"
    return _strict(expected, lambda v: _is_list(v) and len(v) == len(members), lambda value: fixed(value, type_))


def _mapping_hook(type_: Any, converter: Converter) -> Hook:
    inner = mapping_structure_factory(type_, converter, structure_to=dict)
    return _strict("an object", _is_object, lambda value: inner(value, type_))


def _dataclass_hook(type_: Any, converter: Converter) -> Hook:
    overrides = {
        f.name: override(rename=f.metadata.get(_KEY)) if f.init else override(omit=True) for f in fields(type_)
    }
    inner = make_dict_structure_fn(type_, converter, _cattrs_forbid_extra_keys=True, **overrides)  # type: ignore[arg-type]
    return _strict("an object", _is_object, lambda value: inner(value, type_))


def _make_converter() -> Converter:
    converter = Converter(detailed_validation=True, forbid_extra_keys=True)
    converter.register_structure_hook(str, _exactly(str, "a string"))
    converter.register_structure_hook(bool, _exactly(bool, "true or false"))
    converter.register_structure_hook(int, _exactly(int, "a whole number"))
    converter.register_structure_hook(float, _strict("a number", _is_number, float))
    converter.register_structure_hook(Path, _strict("a path", lambda v: isinstance(v, str), Path))
    converter.register_structure_hook_func(lambda t: t is type(None), _exactly(type(None), "null"))
    factories: tuple[tuple[Callable[[Any], bool], Any], ...] = (
        (is_sequence, _sequence_hook),
        (lambda t: t is tuple or get_origin(t) is tuple, _tuple_hook),
        (is_mapping, _mapping_hook),
        (lambda t: get_origin(t) is Literal, _literal_hook),
        (lambda t: get_origin(t) in (Union, UnionType), _union_hook),
        (lambda t: isinstance(t, type) and is_dataclass(t), _dataclass_hook),
    )
    for matches, factory in factories:
        converter.register_structure_hook_factory(matches, factory)
    return converter


_CONVERTER = _make_converter()
