"""Archives from anyone: what is unpacked, and what is refused before it costs anything."""

import gzip
import io
import struct
import tarfile
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from registration.errors import InputError
from tests.workflows.service.archives import tar_of, tar_with, zip_of
from workflows.service.archives import TooLarge, digest_of_files, files_of, unpack
from workflows.service.settings import UploadLimits

SMALL = UploadLimits(max_unpacked_bytes=10_000_000, max_entries=50)
HEADER = b"PK\x01\x02" + bytes(42)  # of a zip's directory


def unpacked(tmp_path: Path, content: bytes, limits: UploadLimits = SMALL) -> dict[str, str]:
    file = tmp_path / "archive"
    file.write_bytes(content)
    return unpack(file, tmp_path / "unpacked", limits)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "source"
    (root / "images" / ("n" * 120)).mkdir(parents=True)
    (root / "capture.toml").write_text('subject = "ännchen"')
    (root / "images" / ("n" * 120) / "öl.png").write_bytes(bytes(range(256)) * 5)
    (root / "empty").write_bytes(b"")
    return root


def as_zip64(content: bytes) -> bytes:
    """The same archive with the records of one that has 65535 entries or more."""
    place = content.rindex(b"PK\x05\x06")
    count, size, offset = struct.unpack("<HII", content[place + 10 : place + 20])
    more = b"PK\x06\x06" + struct.pack("<QHHIIQQQQ", 44, 45, 45, 0, 0, count, count, size, offset)
    more += b"PK\x06\x07" + struct.pack("<IQI", 0, place, 1)
    return content[:place] + more + content[place : place + 8] + b"\xff" * 12 + b"\0\0"


@pytest.mark.parametrize("kind", ["gnu", "pax", "ustar", "gz", "zip", "zip64"])
def test_all_kinds_give_the_same_files(tmp_path, folder, kind):
    formats = {"gnu": tarfile.GNU_FORMAT, "pax": tarfile.PAX_FORMAT, "ustar": tarfile.USTAR_FORMAT}
    if kind in formats:
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=formats[kind]) as tar:
            tar.add(folder, "")
        content = buffer.getvalue()
    else:
        content = {"zip": zip_of(folder), "zip64": as_zip64(zip_of(folder)), "gz": tar_of(folder)}[kind]
    digests = unpacked(tmp_path, content)
    found = files_of(tmp_path / "unpacked")
    assert list(digests) and sorted(digests) == sorted(found) == sorted(files_of(folder))
    assert all(found[name].read_bytes() == path.read_bytes() for name, path in files_of(folder).items())
    assert digest_of_files(digests) != digest_of_files({**digests, "empty": "other"})


@pytest.mark.parametrize(
    "content",
    [
        tar_with("link", tarfile.SYMTYPE, linkname="/etc/passwd"),
        tar_with("link", tarfile.LNKTYPE, linkname="capture.toml"),
        tar_with("device", tarfile.CHRTYPE),
        tar_with("pipe", tarfile.FIFOTYPE),
        tar_with("sparse", tarfile.GNUTYPE_SPARSE),
        tar_with("/etc/passwd", content=b"x"),
        tar_with("a/../../b", content=b"x"),
        tar_with("a\x1b[2Jb", content=b"x"),
        tar_with("a\\b", content=b"x"),
        tar_with("/".join("abcdefghijklmnopqrstu"), content=b"x"),
        tar_with("x" * 300, content=b"x"),
        tar_with("capture.toml", content=b"x" * 5000)[:2000],
        tar_with("capture.toml", content=b"x")[:1024],
        gzip.compress(tar_with("a", content=bytes(range(256)) * 400))[:300],
        tar_with("a", pax_headers={"GNU.sparse.major": "1"}),
        tar_with("a", pax_headers={"size": "-5"}),
        b"<html>",
        b"",
        b"PK\x03\x04" + bytes(100),
        bytes(100),
    ],
    ids=lambda content: f"{len(content)}",  # no content: a gzip holds the time
)
def test_what_is_no_capture_is_refused(tmp_path, content):
    with pytest.raises(InputError, match="The archive is"):
        unpacked(tmp_path, content)
    assert not (tmp_path / "b").exists() and len(files_of(tmp_path / "unpacked")) <= 1


def test_two_entries_of_one_name_are_refused(tmp_path):
    for first, second in (("a", "a"), ("a", "./a"), ("a", "a/b"), ("a/b", "a")):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w") as tar:
            for name in (first, second):
                tar.addfile(tarfile.TarInfo(name), io.BytesIO())
        with pytest.raises(InputError, match="refused") as refusal:
            unpacked(tmp_path, buffer.getvalue())
        assert "once" in refusal.value.expected
        (tmp_path / "unpacked").rename(tmp_path / f"{first}{second}".replace("/", "-"))


def test_links_and_foreign_names_in_a_zip_are_refused(tmp_path):
    link = zipfile.ZipInfo("link")
    link.external_attr = 0o120777 << 16
    for number, info in enumerate((link, zipfile.ZipInfo("../b"), zipfile.ZipInfo("/b"), zipfile.ZipInfo("a\nb"))):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr(info, "x")
        place = tmp_path / str(number)
        place.mkdir()
        with pytest.raises(InputError, match="refused"):
            unpacked(place, buffer.getvalue())
        assert not files_of(place / "unpacked")


def test_bombs_are_refused_by_their_ratio(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", bytes(20_000_000))
    for number, content in enumerate((gzip.compress(tar_with("a", content=bytes(20_000_000))), buffer.getvalue())):
        place = tmp_path / str(number)
        place.mkdir()
        with pytest.raises(TooLarge, match="too large"):
            unpacked(place, content, UploadLimits())
        assert sum(path.stat().st_size for path in files_of(place / "unpacked").values()) <= 200 * len(content)


def test_a_header_that_wants_memory_is_refused(tmp_path):
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 2**40
    with pytest.raises(TooLarge):
        unpacked(tmp_path, info.tobuf(tarfile.GNU_FORMAT) + bytes(4096))


def test_a_tar_of_a_million_entries_is_refused_at_the_limit(tmp_path):
    entry = tarfile.TarInfo("folder")
    entry.type = tarfile.DIRTYPE
    content = gzip.compress(entry.tobuf() * 10_000) * 100  # members of a gzip file follow each other
    tracemalloc.start()
    try:
        with pytest.raises(TooLarge) as refusal:
            unpacked(tmp_path, content, UploadLimits(max_entries=2_000))
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()
    assert "2000 entries" in refusal.value.expected


@pytest.mark.parametrize("stated", [1_000_000, 7, 0xFFFF], ids=["true", "a lie", "zip64"])
def test_a_zip_of_a_million_entries_is_refused_before_its_directory_is_read(tmp_path, stated):
    directory = HEADER * 1_000_000
    numbers = 0xFFFF if stated > 0xFFFF else stated
    end64 = b""
    if numbers == 0xFFFF:
        end64 = b"PK\x06\x06" + struct.pack("<QHHIIQQQQ", 44, 45, 45, 0, 0, 10**6, 10**6, len(directory), 0)
        end64 += b"PK\x06\x07" + struct.pack("<IQI", 0, len(directory), 1)
    end = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, numbers, numbers, len(directory), 0, 0)
    tracemalloc.start()
    try:
        with pytest.raises(TooLarge):
            unpacked(tmp_path, directory + end64 + end, UploadLimits())
        assert tracemalloc.get_traced_memory()[1] < 150_000_000  # the archive itself, twice
    finally:
        tracemalloc.stop()


def test_a_damaged_zip_is_refused(tmp_path, folder):
    content = bytearray(zip_of(folder))
    content[60:64] = b"\xff\xff\xff\xff"
    with pytest.raises(InputError, match="refused"):
        unpacked(tmp_path, bytes(content))
