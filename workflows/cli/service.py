"""Commands of the service: serve, tokens (docs/service.md)."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from workflows.cli.options import NOT_SET, FarmOptions, Port

_FARM = FarmOptions()
RoleName = Literal["viewer", "operator", "reviewer"]


def serve(
    farm: FarmOptions = _FARM,
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Port = 8080,
    workers: Annotated[int, arg(metavar="N")] = 0,
    root: Annotated[tuple[str, ...], arg(metavar="FOLDER|URL", help_behavior_hint=NOT_SET)] = (),
    name: Annotated[tuple[str, ...], arg(metavar="HOST", help_behavior_hint=NOT_SET)] = (),
    https: bool = False,
) -> int:
    """Serve the API and the pages of a farm.

    Args:
        farm: Which farm.
        host: Address to listen on. Beyond this machine only if there are tokens.
        port: Port to listen on; 0: any free one.
        workers: Also start a farm on this machine: a coordinator and this many workers, or one for each GPU.
        root: Submitted captures, models and results must lie below one of these folders and URLs or the farm's folder.
        name: Host names by which browsers reach the service, besides ADDRESS.
        https: Browsers reach the service by HTTPS, through a proxy: cookies are sent over HTTPS only.
    """
    from workflows.service.server import serve
    from workflows.service.settings import ServiceSettings

    settings = ServiceSettings(
        url=farm.url, folder=farm.directory.resolve(), roots=root, host=host, port=port, names=name, https=https
    )
    serve(settings, workers=workers)
    return 0


def token_create(
    name: Annotated[str, arg(metavar="NAME")],
    role: Annotated[tuple[RoleName, ...], arg(metavar="{viewer,operator,reviewer}")] = ("viewer",),
    days: Annotated[float | None, arg(metavar="N", help_behavior_hint="(default: it does not expire)")] = None,
    folder: Annotated[Path, arg(metavar="DIR")] = Path("."),
) -> int:
    """Create a token for a person or program, and print it.

    Args:
        name: Of the person or program, for logs.
        role: viewer: see everything. operator: also submit, upload, cancel, retry. reviewer: also decide at the gate.
        days: Days until it expires.
        folder: Folder of the farm.
    """
    print(_tokens(folder).create(name, role, days=days))
    return 0


def token_list(folder: Annotated[Path, arg(metavar="DIR")] = Path(".")) -> int:
    """List the tokens of a farm: names, roles, dates.

    Args:
        folder: Folder of the farm.
    """
    for token in _tokens(folder).all():
        until = "does not expire" if token.expires is None else f"expires {_date(token.expires)}"
        print(f"{token.name}: {', '.join(token.roles)}; created {_date(token.created)}, {until}")
    return 0


def token_revoke(
    name: Positional[Annotated[str, arg(metavar="NAME")]], /, folder: Annotated[Path, arg(metavar="DIR")] = Path(".")
) -> int:
    """Remove a token; its sessions end.

    Args:
        name: Of the token.
        folder: Folder of the farm.
    """
    _tokens(folder).revoke(name)
    print(f"{name} is revoked")
    return 0


def _tokens(folder: Path):  # type: ignore[no-untyped-def]
    from workflows.service.settings import ServiceSettings
    from workflows.service.tokens import Tokens

    return Tokens(ServiceSettings(url="", folder=folder).state)


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d")
