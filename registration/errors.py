"""The one error that users see for bad input."""


class InputError(Exception):
    """Something a user handed us cannot be used.

    Every part is a plain phrase: `what` is wrong, `where` it is (file, field, view), what was `expected`,
    what we `got`, and how to `fix` it. It is raised before any expensive work and before anything is written.
    """

    def __init__(self, what: str, *, where: object, expected: object, got: object, fix: str):
        self.what = what
        self.where = str(where)
        self.expected = str(expected)
        self.got = str(got)
        self.fix = fix
        super().__init__(what)

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
        """The same in one line, for tables."""
        return f"{self.what}: {self.where}; expected {self.expected}, got {self.got}; {self.fix}"
