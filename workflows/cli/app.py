"""The command line, `gnmreg`: every command reads its arguments, calls the library once and prints the outcome.

The library is imported inside the commands, so that help and usage errors never wait for torch or mitsuba.
Exit codes: 0 success; 1 a registration, or some of a subject's, failed; 2 arguments or input that cannot be used, or
a subject without any usable registration; 130 interrupted.
"""

import difflib
import inspect
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import NoReturn

import tyro

from registration.errors import InputError
from workflows.cli import capture, coregister, farm, model, register, stabilize, store
from workflows.cli.options import Command

DESCRIPTION = "Register multi-view captures of human heads as meshes of one topology, and build head models from them."
HELP = ("-h", "--help")

GROUPS: Mapping[str, Mapping[str, Command]] = {
    "Capture": {
        "capture check": capture.check,
        "capture synth": capture.synth,
        "capture degrade": capture.degrade,
        "dataset synth": capture.synth_dataset,
    },
    "Register": {
        "register": register.register,
        "subject": register.subject,
        "batch": farm.batch,
        "evaluate": register.evaluate,
        "stabilize": stabilize.stabilize,
        "stabilize review": stabilize.review,
    },
    "Model": {
        "coregister": coregister.coregister,
        "model bootstrap": model.bootstrap,
        "model fetch": model.fetch,
        "model info": model.info,
        "model evaluate": model.evaluate,
    },
    "Farm": {
        "worker": farm.worker,
        "coordinator": farm.coordinator,
        "status": farm.status,
        "logs": farm.logs,
        "debug": farm.debug,
        "retry": farm.retry,
        "cancel": farm.cancel,
        "migrate": farm.migrate,
        "store verify": store.verify,
        "store retire": store.retire,
    },
}
COMMANDS: Mapping[str, Command] = {name: command for group in GROUPS.values() for name, command in group.items()}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; `args` replaces the process's own. Returns the exit code."""
    words = list(sys.argv[1:] if args is None else args)
    name = _command_name(words)
    if name is None:
        _explain(words)
    try:
        _reject_repeated_options(words)
        return tyro.cli(
            COMMANDS[name],
            prog=f"gnmreg {name}",
            args=words[len(name.split()) :],
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
        )
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def overview(prefix: str = "") -> str:
    """Return the help of `gnmreg`, or of a command's first word such as `capture`: all commands by group."""
    shown = {
        title: {name: command for name, command in group.items() if name.startswith(prefix)}
        for title, group in GROUPS.items()
    }
    width = max(len(name) for group in shown.values() for name in group)
    columns = max(60, min(shutil.get_terminal_size().columns, 100))
    lines = [f"usage: gnmreg {prefix}COMMAND [-h] [ARGUMENTS]", "", *textwrap.wrap(DESCRIPTION, columns)]
    for title, group in shown.items():
        if group:
            lines += ["", title]
            lines += [line for name, command in group.items() for line in _row(name, command, width, columns)]
    return "\n".join((*lines, "", f"gnmreg {prefix}COMMAND --help explains a command and its options."))


def _row(name: str, command: Command, width: int, columns: int) -> Iterator[str]:
    summary = (inspect.getdoc(command) or "").splitlines()[0]
    indent = " " * (width + 4)
    yield from textwrap.wrap(summary, columns, initial_indent=f"  {name:<{width}}  ", subsequent_indent=indent)


def _command_name(words: Sequence[str]) -> str | None:
    """The longest command that the arguments begin with."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if len(words) >= count and name in COMMANDS:
            return name
    return None


def _explain(words: Sequence[str]) -> NoReturn:
    """Print the overview on request, or say what is wrong with arguments that begin with no command, and exit."""
    prefix = f"{words[0]} " if words and any(name.startswith(f"{words[0]} ") for name in COMMANDS) else ""
    typed = words[1:] if prefix else words
    if typed and typed[0] in HELP:
        print(overview(prefix))
        sys.exit(0)
    if typed:
        name = f"{prefix}{typed[0]}"
        close = difflib.get_close_matches(name, COMMANDS, n=3)
        hint = f"; similar: {', '.join(close)}" if close else ""
        print(f"gnmreg: there is no command {name!r}{hint}\n", file=sys.stderr)
    print(overview(prefix), file=sys.stderr)
    sys.exit(2)


def _reject_repeated_options(words: Sequence[str]) -> None:
    """Raise InputError for an option that is given twice: the parser would use the last and ignore the other."""
    options = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    for option in options:
        if options.count(option) > 1:
            raise InputError(
                "An option is given more than once",
                where=option,
                expected="each option once",
                got=f"{options.count(option)} times",
                fix=f"give it once; where it takes several values, all after one {option}",
            )
