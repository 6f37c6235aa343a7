"""The command line, `gnmreg`: every command reads its arguments, calls the library once and prints the outcome.

The library is imported inside the commands, so that help and usage errors never wait for torch or mitsuba.
Exit codes: 0 success; 1 a registration, or some of a subject's or a batch's, failed; 2 arguments or input that cannot
be used, or a subject without any usable registration; 130 interrupted; 141 nobody reads the output any more.
"""

import functools
import inspect
import os
import select
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, NoReturn

import tyro

from registration.errors import InputError
from registration.storage.files import DiskFull
from registration.terminal import escaped_output, printable
from workflows.cli import (
    calibration,
    capture,
    coregister,
    dataset,
    export,
    farm,
    fit,
    gate,
    importing,
    model,
    register,
    sampler,
    service,
    stabilize,
    stereo,
    store,
)
from workflows.cli.arguments import (
    PRINT_COMPLETION,
    SHELLS,
    check_words,
    completion,
    merge_repeated_options,
    unusable_path,
)
from workflows.cli.options import Command
from workflows.ids import nearest, redact

DESCRIPTION = "Register multi-view captures of human heads as meshes of one topology, and build head models from them."
HELP = ("-h", "--help")

GROUPS: Mapping[str, Mapping[str, Command]] = {
    "Capture": {
        "capture import": importing.import_capture,
        "capture calibrate": calibration.calibrate,
        "capture check": capture.check,
        "capture complete": capture.complete,
        "capture detect": capture.detect,
        "capture synth": capture.synth,
        "capture degrade": capture.degrade,
        "stereo": stereo.stereo,
        "dataset synth": capture.synth_dataset,
        "dataset import": importing.import_dataset,
        "dataset describe": dataset.describe,
    },
    "Register": {
        "fit": fit.fit,
        "register": register.register,
        "subject": register.subject,
        "batch": farm.batch,
        "evaluate": register.evaluate,
        "stabilize": stabilize.stabilize,
        "stabilize review": stabilize.review,
        "export": export.export,
    },
    "Model": {
        "coregister": coregister.coregister,
        "model bootstrap": model.bootstrap,
        "model cranium": model.cranium,
        "model anatomy": model.anatomy,
        "model place": model.place,
        "model landmarks": model.landmarks,
        "model map": model.map_,
        "model fetch": model.fetch,
        "model info": model.info,
        "model export": model.export,
        "model evaluate": model.evaluate,
        "model compare": model.compare,
        "sampler train": sampler.train,
        "sample": sampler.sample,
    },
    "Farm": {
        "serve": service.serve,
        "token create": service.token_create,
        "token list": service.token_list,
        "token revoke": service.token_revoke,
        "worker": farm.worker,
        "coordinator": farm.coordinator,
        "status": farm.status,
        "logs": farm.logs,
        "debug": farm.debug,
        "retry": farm.retry,
        "cancel": farm.cancel,
        "migrate": farm.migrate,
        "gate verdicts": gate.verdicts,
        "gate calibrate": gate.calibrate,
        "gate decide": gate.decide,
        "gate verify": gate.verify,
        "gate replay": gate.replay,
        "store verify": store.verify,
        "store retire": store.retire,
    },
}
COMMANDS: Mapping[str, Command] = {name: command for group in GROUPS.values() for name, command in group.items()}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; `args` replaces the process's own. Returns the exit code."""
    try:
        code = _run(list(sys.argv[1:] if args is None else args))
        sys.stdout.flush()
        return code
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except DiskFull as error:
        print(f"The disk is full\n  where:    {printable(str(error.filename))}", file=sys.stderr)
        print(f"  got:      {error.strerror}\n  fix:      free space on it, then repeat the command", file=sys.stderr)
        return 1
    except BrokenPipeError:
        if not _nobody_reads():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else the interpreter complains when it ends
        return 141
    except OSError as error:
        if error.filename is None:  # not of a file that the user named
            raise
        print(unusable_path(error), file=sys.stderr)
        return 2


def print_unexpected(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print the traceback of an error that is a bug, without passwords and control characters."""
    from traceback import format_exception

    print(printable(redact("".join(format_exception(kind, error, trace)))), end="", file=sys.stderr)


def _run(words: list[str]) -> int:
    check_words(words)
    name = _command_name(words)
    if name is None:
        _explain(words)
    return tyro.cli(
        _printing(COMMANDS[name]),
        prog=f"gnmreg {name}",
        args=merge_repeated_options(words[len(name.split()) :], COMMANDS[name]),
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
    )


def _printing(command: Command) -> Command:
    """The command with its output made printable: names from files may hold escape sequences of terminals."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> int:
        with escaped_output():
            return command(*arguments, **options)

    return run


def _nobody_reads() -> bool:
    """Whether the reader of our output has gone, as `head` does."""
    try:
        descriptor = sys.stdout.fileno()
    except (OSError, ValueError):
        return False
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return any(event & select.POLLERR for _, event in poll.poll(0))


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
    lines += ["", f"gnmreg {prefix}COMMAND --help explains a command and its options."]
    if not prefix:
        shells = "|".join(SHELLS)
        lines += [f"gnmreg --version prints the release, gnmreg {PRINT_COMPLETION} {shells} a completion script."]
    return "\n".join(lines)


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
    """Answer arguments that begin with no command: help, version, completion, or what is wrong with them; and exit."""
    prefix = f"{words[0]} " if words and any(name.startswith(f"{words[0]} ") for name in COMMANDS) else ""
    typed = words[1:] if prefix else words
    if typed and typed[0] in HELP:
        print(overview(prefix))
    elif typed and typed[0] == "--version":
        print(_version())
    elif typed and typed[0].partition("=")[0] == PRINT_COMPLETION:
        shell = typed[0].partition("=")[2] or " ".join(typed[1:])
        print(completion(shell, COMMANDS))
    elif typed and not typed[0].startswith("-"):
        print(_unknown(prefix + typed[0], typed), file=sys.stderr)
        sys.exit(2)
    else:
        if typed:
            print(f"gnmreg: there is no option {typed[0]!r} without a command\n", file=sys.stderr)
        print(overview(prefix), file=sys.stderr)
        sys.exit(2)
    sys.stdout.flush()
    sys.exit(0)


def _unknown(name: str, typed: Sequence[str]) -> str:
    """What is said about a command that does not exist: the nearest ones first."""
    words = [" ".join(typed[:2]), name, typed[0]]
    close = list(dict.fromkeys(found for word in words for found in nearest(word.replace("-", " "), COMMANDS)))
    close += [known for known in COMMANDS if typed[0] in known.split() and known not in close]
    hint = f"; similar: {', '.join(close)}" if close else ""
    listed = [line for group in GROUPS.values() for line in textwrap.wrap(", ".join(group), 100)]
    return "\n".join((f"gnmreg: there is no command {name!r}{hint}", "", *listed, "", "gnmreg --help explains them."))


def _version() -> str:
    from importlib.metadata import version

    return f"gnmreg {version('gnm-registration')}"
