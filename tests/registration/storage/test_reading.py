"""The guarded way in for files: kinds, sizes, texts, JSON and TOML."""

import os
import socket
from functools import partial
from pathlib import Path

import pytest

from registration.errors import InputError
from registration.storage import reading

REFUSE = partial(InputError.unreadable, "file", where="here", fix="write it again")


def refusal(read, *arguments, **options):
    with pytest.raises(InputError) as caught:
        read(*arguments, REFUSE, **options)
    return f"{caught.value.expected}: {caught.value.got}"


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    os.symlink("/nowhere", tmp_path / "dangling")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
    got = {
        name: refusal(reading.read_bytes, tmp_path / name)
        for name in ("pipe", "folder", "loop", "dangling", "socket", "none", "n" * 300, "a\0b", "\udcff")
    }
    assert "a named pipe" in got["pipe"] and "a folder" in got["folder"] and "a socket" in got["socket"]
    assert "symbolic links" in got["loop"] and "no such file" in got["dangling"] and "no such file" in got["none"]
    assert "too long" in got["n" * 300] and "NUL" in got["a\0b"] and "no such file" in got["\udcff"]
    assert "a device" in refusal(reading.read_bytes, Path("/dev/zero"))


def test_a_link_to_a_file_is_followed(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "link").symlink_to("file")
    assert reading.read_bytes(tmp_path / "link", REFUSE) == b"x"


def test_a_large_file_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**40)
    assert str(2**40) in refusal(reading.read_bytes, tmp_path / "large")
    assert "more" in refusal(reading.read_bytes, Path("/proc/self/smaps"), max_bytes=10)  # its size is 0


@pytest.mark.parametrize(
    ("content", "got"), [(b"ok\n\xe9", "byte 0xe9 in line 2"), (b"a\n\nb\0", "NUL character in line 3")]
)
def test_text_is_utf8_without_nul(tmp_path, content, got):
    (tmp_path / "text").write_bytes(content)
    assert got in refusal(reading.read_text, tmp_path / "text")


def test_lists_and_lines_have_no_byte_order_mark(tmp_path):
    (tmp_path / "list").write_bytes(b"\xef\xbb\xbf a b \r\n\r\nc\n")
    assert reading.read_list(tmp_path / "list", REFUSE) == ["a b", "c"]
    assert list(reading.raw_lines(tmp_path / "list", REFUSE)) == [b" a b ", b"", b"c"]


def test_only_line_feeds_and_carriage_returns_end_lines(tmp_path):
    (tmp_path / "text").write_bytes("\ufeffa\rb\x0cc\u2028d\r\n\ne".encode())
    lines = [line.decode() for line in reading.raw_lines(tmp_path / "text", REFUSE)]
    assert lines == ["a", "b\x0cc\u2028d", "", "e"]
    (tmp_path / "text").write_bytes(b"a\nb\0")
    with pytest.raises(InputError, match="NUL character in line 2"):
        list(reading.raw_lines(tmp_path / "text", REFUSE))


def test_a_line_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MAX_LINE_BYTES", 100)
    (tmp_path / "text").write_bytes(b"a\n" + b"x" * 101)
    with pytest.raises(InputError, match="a longer line 2"):
        list(reading.raw_lines(tmp_path / "text", REFUSE))


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("[" * 100_000, "more"),
        ("[" * 80 + "]" * 80, "more than 64 levels"),
        ("9" * 100_000, "more than 64 bits"),
        (str(2**63), "more than 64 bits"),
        ("1e999", "too large"),
        ("NaN", "NaN is no JSON number"),
        ("-Infinity", "no JSON number"),
        ('{"a": 1, "a": 2}', "'a' occurs twice"),
        (r'["\u0000"]', "NUL"),
        (r'{"\ud800": 1}', "surrogate"),
        ('"\\', "no JSON"),
        ("", "no JSON"),
    ],
)
def test_json_that_a_record_cannot_hold_is_refused(text, got):
    assert got in refusal(reading.parse_json, text)


def test_json_of_too_many_values_is_refused(monkeypatch):
    monkeypatch.setattr(reading, "MAX_ITEMS", 1000)
    assert "1002" in refusal(reading.parse_json, "[" + "0," * 1001 + "0]")


def test_json_with_a_byte_order_mark_is_read():
    assert reading.parse_json(b'\xef\xbb\xbf{"a": [1, -2.5, "\xc3\xa9", null]}', REFUSE) == {"a": [1, -2.5, "é", None]}
    assert reading.parse_json(str(-(2**63 - 1)), REFUSE) == -(2**63 - 1)


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("a = " + "[" * 10_000, "more"),
        (".".join(["a"] * 200) + " = 1", "more than 64 levels"),
        ("a = " + "9" * 100_000, ""),
        (f"a = {2**64}", "more than 64 bits"),
        ("a = nan", "nan"),
        ("a = 1\na = 2", "overwrite"),
        ("a = 2024-13-45", ""),
        (r'a = "\u0000"', "NUL"),
    ],
)
def test_toml_that_settings_cannot_hold_is_refused(text, got):
    assert got in refusal(reading.parse_toml, text.encode())


def test_toml_with_a_byte_order_mark_is_read():
    assert reading.parse_toml(b'\xef\xbb\xbfa = "b"\n', REFUSE) == {"a": "b"}


@pytest.mark.parametrize("path", ["a\0b", "\udcff", "n" * 256, "d/" * 2100])
def test_unusable_paths_are_named(path):
    assert reading.path_defect(path)
    assert reading.path_defect("/tmp/ä b") is None
