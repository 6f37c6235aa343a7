"""The one error that users see for bad input."""


class InputError(Exception):
    """The user's input cannot be used.

    Every part is a plain phrase: `what` is wrong, `where` it is (file, field, view), what was `expected`,
    what we `got`, and how to `fix` it. It is raised before any expensive work and before anything is written.
    """

    def __init__(self, what: str, *, where: object, expected: object, got: object, fix: str = "change it"):
        self.what = what
        self.where = str(where)
        self.expected = str(expected)
        self.got = str(got)
        self.fix = fix
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
