"""What the parser does not do: the options of a command as data, repeated options, completion in shells."""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from tyro.conf import Positional, Suppress

from registration.errors import InputError

SHELLS = ("bash", "zsh", "fish")
PRINT_COMPLETION = "--print-completion"
_ARGUMENT_CONFIG = "_ArgConfig"  # the type of what `tyro.conf.arg` returns, which tyro does not export


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option of a command, with its dashes."""

    name: str
    summary: str  # the first sentence of its help
    values: int | None  # how many follow it; None: any number
    choices: tuple[str, ...] = ()


def check_words(words: Sequence[str]) -> None:
    """Refuse arguments that are no UTF-8: they could neither be printed nor stored. Raises InputError."""
    for word in words:
        try:
            word.encode("utf-8")
        except UnicodeEncodeError:
            raise InputError(
                "An argument cannot be read",
                where="the command line",
                expected="text in UTF-8",
                got=ascii(word),
                fix="rename the file or folder",
            ) from None


def unusable_path(error: OSError) -> InputError:
    """Return the error for a path that the system refuses: too long, a loop of links, without permission."""
    return InputError(
        "A file or folder cannot be used",
        where=error.filename,
        expected="a path that can be opened, read and written",
        got=error.strerror or type(error).__name__,
        fix="check the path, its permissions and the disk",
    )


def options_of(command: Callable[..., int]) -> dict[str, Option]:
    """Return the options of a command, by name, in the order of its help."""
    found = {option.name: option for option in _options(command, get_type_hints(command, include_extras=True))}
    return {"--help": Option(name="--help", summary="Show this help message and exit", values=0), **found}


def merge_repeated_options(words: Sequence[str], command: Callable[..., int]) -> list[str]:
    """Return a command's arguments with each option once: of repeated ones that take several values, all are kept.

    Raises:
        InputError: an option of one value is repeated: the parser would use the last and ignore the others.
    """
    given = [_name(word) for word in words]
    repeated = {name for name in given if name is not None and given.count(name) > 1}
    if not repeated:
        return list(words)
    options = options_of(command)
    for name in sorted(repeated):
        if name in options and options[name].values is not None:
            raise InputError(
                "An option is given more than once",
                where=name,
                expected="each option once",
                got=f"{given.count(name)} times",
                fix="give it once",
            )
    values: dict[str, list[str]] = {}
    others: list[str] = []
    current = others
    for word, option in zip(words, given, strict=True):
        if option is None:
            current.append(word)
        elif option in repeated:
            current = values.setdefault(option, [])
            current += [word.partition("=")[2]] if "=" in word else []
        else:
            current = others
            current.append(word)
    return [*others, *(word for name, of in values.items() for word in (name, *of))]


def completion(shell: str, commands: Mapping[str, Callable[..., int]]) -> str:
    """Return a script by which a shell completes `gnmreg`.

    Args:
        shell: one of SHELLS.
        commands: name -> function.

    Raises:
        InputError: another shell.
    """
    if shell not in SHELLS:
        raise InputError(
            "There is no completion for this shell",
            where=PRINT_COMPLETION,
            expected=" or ".join(SHELLS),
            got=shell or "nothing",
            fix="name one of these",
        )
    options = {name: options_of(command) for name, command in commands.items()}
    return _fish(options) if shell == "fish" else _bash(options, zsh=shell == "zsh")


def _bash(options: Mapping[str, Mapping[str, Option]], *, zsh: bool) -> str:
    words = " ".join(sorted({name.split()[0] for name in options}))
    groups = sorted({name.split()[0] for name in options if " " in name})
    seconds = {group: [name.split()[1] for name in options if name.startswith(f"{group} ")] for group in groups}
    second = [f'    {group}) words="{" ".join(names)}" ;;' for group, names in seconds.items()]
    listed = [f'    "{name}") words="{" ".join(of)}" ;;' for name, of in options.items()]
    chosen = [
        f'    "{name} {option.name}") words="{" ".join(option.choices)}" ;;'
        for name, of in options.items()
        for option in of.values()
        if option.choices
    ]
    return "\n".join(
        (
            *(["autoload -U +X bashcompinit && bashcompinit"] if zsh else []),
            "_gnmreg() {",
            '  local current="${COMP_WORDS[COMP_CWORD]}" previous="${COMP_WORDS[COMP_CWORD-1]}" words=""',
            '  local command="${COMP_WORDS[1]}"',
            '  case "$command ${COMP_WORDS[2]}" in',
            "    " + "|".join(f'"{name}"' for name in options if " " in name) + ') command="$command ${COMP_WORDS[2]}"',
            "  esac",
            f'  if [ "$COMP_CWORD" -eq 1 ]; then words="{words} --help --version"',
            '  elif [[ "$current" == -* ]]; then case "$command" in',
            *listed,
            "    esac",
            '  else case "$command $previous" in',
            *chosen,
            "    esac",
            '    if [ "$COMP_CWORD" -eq 2 ]; then case "$command" in',
            *second,
            "    esac; fi",
            "  fi",
            '  COMPREPLY=($(compgen -W "$words" -- "$current"))',
            "}",
            "complete -o default -F _gnmreg gnmreg",  # paths where there is nothing else
        )
    )


def _fish(options: Mapping[str, Mapping[str, Option]]) -> str:
    lines = [
        "complete -c gnmreg -n __fish_use_subcommand -a '" + " ".join(sorted({n.split()[0] for n in options})) + "'"
    ]
    for name, of in options.items():
        first, *second = name.split()
        if second:
            lines.append(f"complete -c gnmreg -n '__fish_seen_subcommand_from {first}' -a '{second[0]}'")
        seen = "; and ".join(f"__fish_seen_subcommand_from {word}" for word in name.split())
        for option in of.values():
            values = "" if option.values == 0 else " -r" + (f" -fa '{' '.join(option.choices)}'" * bool(option.choices))
            summary = option.summary.replace("\\", "\\\\").replace("'", "\\'")
            lines.append(f"complete -c gnmreg -n '{seen}' -l {option.name[2:]} -d '{summary}'{values}")
    return "\n".join(lines)


def _options(source: Any, hints: Mapping[str, Any]) -> Iterator[Option]:
    """Options of a command, or of a group of options; those of its base classes are among its hints."""
    if is_dataclass(source):
        defaults = {field.name: field.default for field in fields(source)}
    else:
        defaults = {name: parameter.default for name, parameter in inspect.signature(source).parameters.items()}
    help_ = _help(source)
    for name, default in defaults.items():
        type_, metadata = _unwrapped(hints[name])
        if is_dataclass(type_) and isinstance(type_, type):
            yield from _options(type_, get_type_hints(type_, include_extras=True))
        elif not _marked(metadata, Positional) and not _marked(metadata, Suppress):
            shown = next((m.name for m in metadata if type(m).__name__ == _ARGUMENT_CONFIG and m.name), name)
            values, choices = _values(type_)
            shown = f"no-{shown}" if default is True else shown  # tyro offers to switch off what is on
            yield Option(
                name=f"--{shown.replace('_', '-')}", summary=help_.get(name, ""), values=values, choices=choices
            )


def _unwrapped(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its annotations, and those."""
    metadata: tuple[Any, ...] = ()
    while get_origin(hint) is Annotated:
        hint, *more = get_args(hint)
        metadata += tuple(more)
    return hint, metadata


def _marked(metadata: Sequence[Any], marker: Any) -> bool:
    """Whether a marker of tyro, or one of its aliases such as `Positional[...]`, is among the annotations."""
    markers = [marker, *_unwrapped(marker[int])[1]]
    return any(item is known for item in metadata for known in markers)


def _values(type_: Any) -> tuple[int | None, tuple[str, ...]]:
    """How many values an option of this type takes (None: any number), and which."""
    origin, arguments = get_origin(type_), get_args(type_)
    if type_ is bool:
        return 0, ()
    if origin in (Union, UnionType):
        return _values(next(argument for argument in arguments if argument is not type(None)))
    if origin is Literal:
        return 1, tuple(map(str, arguments))
    if origin is tuple:
        return (None if arguments[-1] is ... else len(arguments)), _values(arguments[0])[1]
    return (None if origin is not None and issubclass(origin, Mapping) else 1), ()


def _help(source: Any) -> dict[str, str]:
    """Name -> the first sentence, from the section Args or Attributes of a docstring; of base classes too."""
    texts: dict[str, str] = {}
    for owner in reversed(source.__mro__) if isinstance(source, type) else (source,):
        name = ""
        for line in (inspect.getdoc(owner) or "").splitlines():
            if line.startswith("    ") and not line.startswith("     ") and ": " in line:
                name, _, texts[name] = (part.strip() for part in line.partition(": "))
            elif line.startswith("     ") and name:
                texts[name] = f"{texts[name]} {line.strip()}"
    return {name: text.partition(". ")[0].rstrip(".") for name, text in texts.items()}


def _name(word: str) -> str | None:
    """The option that a word names, None for a value."""
    return word.partition("=")[0].replace("_", "-") if word.startswith("--") and len(word) > 2 else None
