"""What an NPZ file unpacks to, before anything is unpacked."""

import zipfile
from pathlib import Path


def check_unpacked(path: Path, limit: int) -> None:
    """Refuse a file whose members would take more than `limit` bytes: a megabyte of deflated zeros may hold a terabyte.

    Raises:
        ValueError: so it would. Other errors as `zipfile`; a file that is no ZIP archive passes, for NumPy to judge.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > limit:
        raise ValueError(f"it would unpack to {unpacked} bytes, more than {limit}")
