"""Public names of a package that are imported on first use."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def attach(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` for a package whose `if TYPE_CHECKING:` block imports its public names.

    Type checkers and editors read that block; at run time it is parsed, and each name is imported when it is first
    needed. No name may be that of a submodule: importing the submodule would replace it.

    Args:
        package: the package's `__name__`.
        file: the package's `__file__`.
    """
    origins = _imported_names(Path(file))

    def get(name: str) -> Any:
        if name not in origins:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = origins[name]
        value = getattr(importlib.import_module(module), attribute)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *origins})

    return get, names


def _imported_names(file: Path) -> dict[str, tuple[str, str]]:
    """Name -> module and attribute, of the imports in a file's `if TYPE_CHECKING:` blocks."""
    blocks = [
        node
        for node in ast.parse(file.read_text("utf-8")).body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    ]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in imports
        if node.module is not None
        for alias in node.names
    }
