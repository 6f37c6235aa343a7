"""What a service is configured with."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
STATE = "service"  # the folder of tokens, keys and logs of requests, within the farm's folder
CAPTURES, RESULTS, MODELS = "captures", "results", "models"  # folders of uploads and results, within the farm's folder
_MIB = 2**20


@dataclass(frozen=True, kw_only=True)
class UploadLimits:
    """What an uploaded capture may contain."""

    max_bytes: int = 8 * 1024 * _MIB  # of the archive as it is sent
    max_unpacked_bytes: int = 16 * 1024 * _MIB
    max_entries: int = 20_000
    max_ratio: float = 200.0  # unpacked to packed bytes


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """Configuration of one service.

    Attributes:
        url: of the queue's database.
        folder: of the farm: logs, uploads, results, and the service's own state.
        roots: folders and URLs that submitted jobs may use, besides the farm's folder.
        host: address to listen on.
        port: to listen on; 0: any free one.
        names: host names by which browsers reach the service, besides the address.
        https: whether browsers reach it by HTTPS, through a proxy: cookies are sent over HTTPS only.
        uploads: limits of uploaded captures.
        poll_s: seconds between two queries for changes of the queue.
    """

    url: str
    folder: Path
    roots: Sequence[str] = ()
    host: str = "127.0.0.1"
    port: int = 8080
    names: Sequence[str] = ()
    https: bool = False
    uploads: UploadLimits = field(default_factory=UploadLimits)
    poll_s: float = 1.0

    @property
    def state(self) -> Path:
        """Folder of tokens, keys and logs of requests."""
        return self.folder / STATE

    @property
    def all_roots(self) -> tuple[str, ...]:
        """Folders and URLs that jobs may use: those of `roots`, and the farm's folder."""
        return (str(self.folder.resolve()), *self.roots)

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches the address."""
        try:
            return self.host == "localhost" or ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def host_names(self) -> frozenset[str]:
        """Names that a request's Host header may have: a foreign name that leads here is refused."""
        own = LOOPBACK_NAMES if self.is_loopback else (self.host,)
        return frozenset(name.lower() for name in (*own, *self.names))
