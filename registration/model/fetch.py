"""Find the official GNM head weights in the caches of this machine, or download them.

Addresses, file names and cache folders are those of Google's own loader (google/GNM, `oss_data_loaders.py`).
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import read_scheme
from registration.progress import NullProgress, Progress
from registration.storage.cache import cache_folder, make_cache_folder
from registration.storage.download import DownloadError, download
from registration.storage.files import atomic_file, read_json_of_kind, write_json
from registration.storage.hashing import hash_file

FILE = "v3_0/gnm_head.npz"
LICENCE = "Apache-2.0"
# Of release 3.0 on Hugging Face, 53,328,601 bytes, as its users state it.
SHA256 = "61d78bbfb4ad8e0b38495804a4caef3214d3df00f8c3f68761e63b41ce3747eb"
RECORD_KIND, RECORD_SCHEMA = "gnm-model-source", 1
_MAX_BYTES = 2**30  # of a download
# The scheme of 68 points, which the hubs do not have; one order of the right jaw or the other, both are read.
LANDMARKS = "https://raw.githubusercontent.com/google/GNM/main/gnm/shape/data/landmarks/head_sparse_68.txt"
_MAX_LANDMARK_BYTES = 2**20
_REVISION = "c01e90d298d82301f9fd18f54806be751775cb7c"  # of the repository on Hugging Face, with that file


@dataclass(frozen=True, kw_only=True)
class Source:
    """A place that offers the official file."""

    name: str
    address: str  # of the file
    page: str  # for people
    sha256: str | None = None  # of the file, if the address names one version of it
    landmarks: str | None = None  # address of the scheme of 68 points


def sources() -> Mapping[str, Source]:
    """Return the public sources by name. `HF_ENDPOINT` and `KAGGLE_API_ENDPOINT` name mirrors of the hubs."""
    hub = os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")
    kaggle = os.environ.get("KAGGLE_API_ENDPOINT", "https://www.kaggle.com").rstrip("/")
    handle, page = "google/gnm-v3", "https://huggingface.co/google/gnm-v3"
    found = (
        Source(
            name="http",
            address=f"https://huggingface.co/{handle}/resolve/main/{FILE}",
            page=page,
            landmarks=LANDMARKS,
        ),
        Source(
            name="huggingface",
            address=f"{hub}/{handle}/resolve/{_REVISION}/{FILE}",
            page=page,
            sha256=SHA256,
            landmarks=LANDMARKS,
        ),
        Source(
            name="kaggle",
            address=f"{kaggle}/api/v1/models/{handle}/other/gnm_head_v3_0/1/download/gnm_head.npz",
            page="https://www.kaggle.com/models/google/gnm-v3",
            landmarks=LANDMARKS,
        ),
    )
    return {source.name: source for source in found}


def cached_path() -> Path:
    """Return the path of the official file in this project's cache. It may not be there yet."""
    return cache_folder() / FILE


def installed_files() -> Iterator[Path]:
    """Yield the official files on this machine: those of Google's loader and of the hubs' programs, then ours."""
    home = Path.home() / ".cache"
    xdg = Path(os.environ["XDG_CACHE_HOME"]) if os.environ.get("XDG_CACHE_HOME") else home
    google = [Path(os.environ["GNM_CACHE_DIR"])] if os.environ.get("GNM_CACHE_DIR") else []
    google += [xdg / "gnm" / "models", home / "gnm" / "models"]
    hub = Path(os.environ.get("HF_HOME") or xdg / "huggingface") / "hub"
    kaggle = Path(os.environ.get("KAGGLEHUB_CACHE") or home / "kagglehub") / "models"
    candidates = [folder / FILE for folder in google]
    for folder in (*google, hub):
        candidates += sorted(folder.glob(f"models--google--gnm-v3/snapshots/*/{FILE}"))
    candidates += [folder / "google_gnm-v3" / FILE for folder in google]
    candidates += sorted(kaggle.glob("google/gnm-v3/other/gnm_head_v3_0/*/gnm_head.npz"), reverse=True)
    for path in dict.fromkeys([*candidates, cached_path()]):
        if path.is_file():
            yield path


def fetch(source: Source | None = None, *, progress: Progress | None = None) -> Path:
    """Return the path of the official model file, from this machine if it is there, else downloaded and checked.

    Args:
        source: where to download from; None: only if no file is found, from `http`. A given source does not change that
            files on this machine are used first.
        progress: where to report to.

    Returns:
        A file in Google's cache, which is left as it is, or in ours. Beside a downloaded file lies a record of its
        source, digest and size (`source_record`).

    Raises:
        InputError: the file cannot be downloaded, is not a GNM model, or not the one that its address names. The
            message names the path where it can be placed by hand. An interrupted download leaves nothing behind.
    """
    progress = progress or NullProgress()
    for path in installed_files():
        try:
            gnm_npz.read(path)
        except InputError as error:
            if path == cached_path():
                raise
            progress.message(f"not used: {path}: {error.got}")
            continue
        if not list(path.parent.glob("head_sparse_*.txt")):
            fix = f"give `--landmarks 68=FILE`, or place {LANDMARKS} there"
            progress.message(f"there is no landmark scheme beside {path}: {fix}")
        return path
    return _download(source or sources()["http"], progress)


def source_record(path: Path) -> Mapping[str, Any] | None:
    """Return where a model file was downloaded from: the JSON object beside it; None if there is none of this file."""
    record = read_json_of_kind(_record_path(path), RECORD_KIND)
    return record if record is not None and record.get("sha256") == hash_file(path) else None


def _record_path(path: Path) -> Path:
    return Path(path).with_suffix(".source.json")


def _download(source: Source, progress: Progress) -> Path:
    path = cached_path()
    make_cache_folder(path.parent)
    by_hand = f"download it on another machine ({source.page}) and place it at {path}"
    progress.message(f"downloading {source.address} (licence: {LICENCE})")
    with atomic_file(path) as temporary:
        try:
            download(
                source.address,
                temporary,
                max_bytes=_MAX_BYTES,
                progress=lambda done, total: progress.update(done, max(total, done), "bytes of the model"),
            )
        except DownloadError as error:
            raise InputError(
                "The official model cannot be downloaded",
                where=source.address,
                expected="a connection to the model's page",
                got=error,
                fix=f"{by_hand}, or try another --source",
            ) from error
        digest, size = hash_file(temporary), temporary.stat().st_size
        if source.sha256 not in (None, digest):
            raise InputError(
                "The downloaded file is not the released model",
                where=source.address,
                expected=f"sha256 {source.sha256}",
                got=f"sha256 {digest}, {size} bytes",
                fix=f"try again; if it stays, {by_hand}",
            )
        try:
            data = gnm_npz.read(temporary)
        except InputError as error:
            fix = f"try another --source, or {by_hand}"
            raise InputError(
                error.what, where=source.address, expected=error.expected, got=error.got, fix=fix
            ) from None
    record = {"kind": RECORD_KIND, "schema": RECORD_SCHEMA, "source": source.name, "address": source.address}
    write_json(_record_path(path), {**record, "sha256": digest, "bytes": size, "licence": LICENCE})
    if digest != SHA256:
        progress.message(f"the file differs from the release that this version knows: sha256 {digest}")
    _download_landmarks(source, path, data, progress)
    return path


def _download_landmarks(source: Source, model: Path, data: GNMData, progress: Progress) -> None:
    """Place the scheme of 68 points beside the model; if that fails, a message says so: the model can be used."""
    if source.landmarks is None:
        return
    path = model.with_name("head_sparse_68.txt")
    try:
        with atomic_file(path) as temporary:
            download(source.landmarks, temporary, max_bytes=_MAX_LANDMARK_BYTES)
            read_scheme(temporary, data.template_vertex_positions, "68")
    except (DownloadError, InputError) as error:
        got = error.got if isinstance(error, InputError) else error
        progress.message(f"the landmark scheme cannot be had ({got}): place {source.landmarks} at {path}")
