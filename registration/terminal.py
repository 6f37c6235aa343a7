"""Text from files, folders and databases on a terminal: control characters are shown, not obeyed.

A name can hold escape sequences that clear the screen, forge lines or hide text, and marks that reverse the order of
letters. Commands print into an `EscapingStream`; what is coloured on purpose goes through `console`, past it.
"""

import sys
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

_KEPT = "\n\t"
_FORMATTING = {0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A), 0x2028, 0x2029, 0xFEFF}


def printable(text: str, kept: str = _KEPT) -> str:
    r"""Return the text with control characters, marks of direction and broken bytes as escapes such as \x1b.

    Args:
        text: from anywhere.
        kept: control characters that stay as they are.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_shown(character) if _acts(character) and character not in kept else character for character in text)


def _acts(character: str) -> bool:
    return unicodedata.category(character) in ("Cc", "Cs") or ord(character) in _FORMATTING


def _shown(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


class EscapingStream:
    """A text stream in front of another one, `unescaped`, that makes what is written printable."""

    def __init__(self, unescaped: Any) -> None:
        self.unescaped = unescaped

    def write(self, text: str) -> int:
        self.unescaped.write(printable(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unescaped, name)


def unescaped(stream: Any) -> Any:
    """Return the stream behind an `EscapingStream`, or the stream itself: for our own control sequences only."""
    return stream.unescaped if isinstance(stream, EscapingStream) else stream


@contextmanager
def escaped_output() -> Iterator[None]:
    """Make everything printable that is written to stdout and stderr in this context."""
    saved = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (EscapingStream(unescaped(stream)) for stream in saved)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = saved


def console(*, stderr: bool = False) -> "Console":
    """Return a console for tables and bars: its own colours reach the terminal, those in names do not.

    Brackets in names are no markup either.
    """
    from rich.console import Console
    from rich.segment import Segment

    class Escaping(Console):
        def _render_buffer(self, buffer: Iterable[Segment]) -> str:
            return super()._render_buffer(
                part if part.control else Segment(printable(part.text), part.style) for part in buffer
            )

    stream = unescaped(sys.stderr if stderr else sys.stdout)
    return Escaping(file=stream, markup=False, emoji=False)
