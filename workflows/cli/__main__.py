"""`python -m workflows.cli` is `gnmreg`, which starts here."""

import sys
from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> int:
    """Run `gnmreg`; an interrupt while it is loaded is no traceback either. Returns the exit code."""
    try:
        from workflows.cli import app
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    sys.excepthook = app.print_unexpected
    return app.main(args)


if __name__ == "__main__":
    sys.exit(main())
