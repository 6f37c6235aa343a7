"""The one error that users see for bad input."""

from registration.terminal import printable

MAX_PART = 800  # letters of a part of a message: what was found in a file may be megabytes
MAX_SEED = 2**63 - 1  # of random number generators, and of integers in databases


class InputError(Exception):
    """The user's input cannot be used.

    Every part is a plain phrase: `what` is wrong, `where` it is (file, field, view), what was `expected`,
    what we `got`, and how to `fix` it. It is raised before any expensive work and before anything is written.
    """

    def __init__(self, what: str, *, where: object, expected: object, got: object, fix: str = "change it"):
        self.what = _shortened(what)
        self.where = _shortened(str(where), kept="")  # names may hold anything, also lines that look like ours
        self.expected = _shortened(str(expected))
        self.got = _shortened(str(got))
        self.fix = _shortened(fix)
        super().__init__(what)

    @classmethod
    def output_folder(
        cls, out: object, *, expected: object, got: object, fix: str = "choose another output folder"
    ) -> "InputError":
        """Return the error for an output folder that must not be written to."""
        return cls("The output folder cannot be used", where=out, expected=expected, got=got, fix=fix)

    @classmethod
    def unreadable(cls, title: str, *, where: object, expected: object, got: object, fix: str) -> "InputError":
        """Return the error for a file or folder that is missing, damaged or of another format; `title` names it."""
        return cls(f"The {title} cannot be read", where=where, expected=expected, got=got, fix=fix)

    def __str__(self) -> str:
        return (
            f"{self.what}\n"
            f"  where:    {self.where}\n"
            f"  expected: {self.expected}\n"
            f"  got:      {self.got}\n"
            f"  fix:      {self.fix}"
        )

    @property
    def line(self) -> str:
        """The message in one line, for tables."""
        return f"{self.what}: {self.where}; expected {self.expected}, got {self.got}; {self.fix}"


def check_seed(seed: int, where: str = "seed") -> None:
    """Refuse a seed that a random number generator does not take.

    Raises:
        InputError: it is negative, or larger than `MAX_SEED`. `where` names it in the message.
    """
    if not 0 <= seed <= MAX_SEED:
        expected = f"a whole number from 0 to {MAX_SEED}"
        raise InputError(
            "The seed is out of range", where=where, expected=expected, got=seed, fix="choose another seed"
        )


def _shortened(text: str, kept: str = "\n\t") -> str:
    """A part of the message, which a terminal can show; `kept`: control characters that stay."""
    if len(text) > MAX_PART:
        text = f"{text[: MAX_PART // 2]} ... {text[-MAX_PART // 4 :]} ({len(text)} letters)"
    return printable(text, kept) or "nothing"
