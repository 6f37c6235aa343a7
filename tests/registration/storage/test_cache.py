import pytest

from registration.errors import InputError
from registration.storage.cache import cache_folder, make_cache_folder


def test_a_cache_below_a_file_is_refused_with_the_remedy(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(InputError, match="cache folder cannot be written") as caught:
        make_cache_folder(cache_folder() / "fetched")
    assert str(tmp_path / "file") in caught.value.where and "XDG_CACHE_HOME" in caught.value.fix


def test_a_cache_that_exists_is_kept(tmp_path):
    (tmp_path / "kept").write_text("")
    make_cache_folder(tmp_path)
    assert (tmp_path / "kept").is_file()
