"""Sections of `python -m bench.sampler`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """The options of the command line."""

    only: tuple[str, ...]
    count: int
    steps: int
    audited: int
    seed: int
    keras: Path | None
    decoders: Path
    out: Path | None


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A measured figure."""

    name: str
    value: str
    limit: str = ""
    kept: bool = True
