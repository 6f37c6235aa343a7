"""Names with control characters are shown, not obeyed."""

import io
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from registration.errors import InputError
from registration.terminal import EscapingStream, console, escaped_output, printable

EVIL = "a\x1b[2J\x1b]0;owned\x07\x9b31m\r\u202egnp\u2066\x00\udcff\u2028"


def test_control_characters_become_escapes() -> None:
    shown = r"a\x1b[2J\x1b]0;owned\x07\x9b31m\r\u202egnp\u2066\x00\udcff\u2028"
    assert printable(EVIL) == shown
    assert printable("Zoë\t3 σ, 名前, 👩‍🔬\n") == "Zoë\t3 σ, 名前, 👩‍🔬\n"


@given(st.text(alphabet=st.characters(), max_size=50))
def test_any_text_can_be_written_to_a_terminal(text: str) -> None:
    shown = printable(text)
    assert not {c for c in shown if ord(c) < 32 or 127 <= ord(c) < 160} - {"\n", "\t"}
    assert shown.encode() is not None and printable(shown) == shown


def test_what_commands_print_is_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    with escaped_output(), escaped_output():
        print(EVIL)
        print(EVIL, file=sys.stderr)
        sys.stdout.writelines([EVIL])
    out, err = capsys.readouterr()
    assert out.count(printable(EVIL)) == 2 and "\x1b" not in out + err
    assert not isinstance(sys.stdout, EscapingStream)


def test_an_error_for_bad_input_is_escaped_and_keeps_its_lines() -> None:
    error = InputError("It is bad", where=f"{EVIL}\n  fix: rm -rf /", expected=EVIL, got=EVIL, fix=EVIL)
    assert "\x1b" not in str(error) + error.line and len(str(error).splitlines()) == 5


def test_a_console_keeps_its_own_colours_only(monkeypatch: pytest.MonkeyPatch) -> None:
    from rich.table import Table

    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(sys, "stdout", terminal)
    table = Table("name")
    table.add_row(f"[link=x]{EVIL}[/]")
    with escaped_output():
        console().print(table, style="bold")
    text = terminal.getvalue()
    assert "\x1b[1m" in text, "the table's own style"
    assert r"\x1b[2J" in text and "\x1b[2J" not in text and "\x1b]" not in text and "[link=x]" in text
