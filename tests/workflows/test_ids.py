"""Places and names: whatever is given, only what lies below a root is opened (property-based)."""

import os
import tempfile
from pathlib import Path

import fsspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from registration.errors import InputError
from workflows.ids import check_location, check_name, is_remote, resolve_place, resolve_roots
from workflows.records.remote import filesystem
from workflows.records.store import Store

SECRET = "secret"


@pytest.fixture(scope="module")
def tree():
    """A root with a file, links that leave it, and names that a URL would read otherwise; a secret beside it."""
    with tempfile.TemporaryDirectory() as name:
        base = Path(os.path.realpath(name))
        root = base / "root"
        for folder in (root / "in", root / "%2e%2e", root / "in?x", root / "a#b", root / "a::b", base / "out"):
            folder.mkdir(parents=True)
            (folder / "f").write_text(folder.name)
        (base / "out" / "f").write_text(SECRET)
        (root / "link").symlink_to(base / "out")
        (root / "loop").symlink_to(root / "loop")
        yield base


PIECES = st.sampled_from(
    [
        *(
            "file:",
            "file://",
            "FILE://",
            "file:///",
            "localhost",
            "local://",
            "s3://",
            "s3://bucket",
            "memory://",
            "x@y",
        ),
        *(
            "simplecache::",
            "zip://",
            "::",
            "/",
            "//",
            "..",
            "%2e%2e",
            "%2E",
            "%2f",
            "%252e",
            "%00",
            "%ff",
            "?",
            "#",
            "~",
        ),
        *(
            "{root}",
            "{base}",
            "in",
            "out",
            "link",
            "loop",
            "f",
            "in?x",
            "a#b",
            "a::b",
            " ",
            "\\",
            "\n",
            "\t",
            ".",
            ";",
            "&",
        ),
    ]
)


@given(st.lists(PIECES, max_size=8).map("".join) | st.text(max_size=40))
@example("file://{root}?/../out/f")
@example("file:{root}/../out/f")
@example("{root}/link/f")
@example("file://{root}/%2e%2e/out/f")
@example("{root}/in::file://{base}/out/f")
def test_what_is_accepted_lies_below_the_root_and_is_what_is_opened(tree: Path, words: str) -> None:
    location = words.replace("{root}", f"{tree}/root").replace("{base}", str(tree))
    roots = resolve_roots((tree / "root", "s3://bucket/runs"))
    try:
        place = check_location(location, roots, "x")
    except InputError as error:
        assert SECRET not in str(error)
        return
    assert resolve_place(place, "x") == place, "a checked place names itself"
    if is_remote(place):
        assert place == "s3://bucket/runs" or place.startswith("s3://bucket/runs/")
        return
    assert place == os.path.realpath(place) and (place + "/").startswith(f"{tree}/root/")
    opened, path = filesystem(place)
    assert not opened.isfile(path) or opened.cat_file(path) != SECRET.encode()
    assert Store(location).url == place


@given(st.text(max_size=30))
def test_any_text_is_a_place_or_refused(words: str) -> None:
    try:
        place = resolve_place(words, "x")
    except InputError:
        return
    assert place.startswith(("/", "s3://")) and not place.startswith("//")


@pytest.mark.parametrize("name", ["in?x", "%2e%2e", "a#b", "a::b"])
def test_a_path_is_taken_literally(tree: Path, name: str) -> None:
    place = resolve_place(f"{tree}/root/{name}/f", "x")
    opened, path = filesystem(place)
    assert opened.cat_file(path) == name.encode()
    assert fsspec.filesystem("file").isfile(path)


@pytest.mark.parametrize(
    "url", ["s3://AKIA:canary@bucket/x", "s3://AKIA:can/ary@bucket/x", "s3://AKIA@bucket", "s3://b/x?Signature=canary"]
)
def test_credentials_are_refused_and_not_repeated(url: str) -> None:
    for use in (lambda: Store(url), lambda: resolve_roots((url,)), lambda: resolve_place(url, "--out")):
        with pytest.raises(InputError) as refused:
            use()
        assert not any(part in str(refused.value) for part in ("AKIA", "canary", "can/"))


def test_names_are_no_paths() -> None:
    assert check_name("s 1", "x") == "s 1"
    for name in ("", ".", "..", "a/b", "/a", "a\0", 5, None):
        with pytest.raises(InputError):
            check_name(name, "x")
