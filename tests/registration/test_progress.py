"""Plain lines in a log, a bar in a terminal."""

import io
import sys

import pytest

from registration import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set; a list with a single number."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_progress_in_a_log_is_lines(clock, capsys):
    """A line when a task starts, then a line every 15 s; messages immediately."""
    with progress.console_progress() as shown:
        for done in range(60):
            shown.update(done, 60, "model")
            clock[0] += 1.0
        shown.message("something [odd]")
        shown.update(0, 30, "offsets")
        shown.update(1, 30, "offsets")
    out, lines = capsys.readouterr()
    assert out == ""
    assert lines.splitlines() == [
        "[   0.0 s] model: 0/60",
        "[  15.0 s] model: 15/60",
        "[  30.0 s] model: 30/60",
        "[  45.0 s] model: 45/60",
        "something [odd]",
        "[  60.0 s] offsets: 0/30",
    ]


def test_progress_in_a_terminal_is_a_bar(monkeypatch):
    """Messages are printed literally: a path may contain text that rich would interpret as markup."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.console_progress() as shown:
        shown.update(3, 10, "offsets [8 mm]")
        shown.message("run[/red] [bold] is there")
        shown.update(7, 10, "offsets [8 mm]")
    text = terminal.getvalue()
    assert "offsets [8 mm]" in text and "7/10" in text
    assert "run[/red] [bold] is there" in text


def test_all_implementations_satisfy_the_protocol(capsys):
    silent = progress.NullProgress()
    assert isinstance(silent, progress.Progress)
    silent.message("a")
    silent.update(1, 2, "b")
    with progress.console_progress() as shown:
        assert isinstance(shown, progress.Progress)
    assert capsys.readouterr() == ("", "")
