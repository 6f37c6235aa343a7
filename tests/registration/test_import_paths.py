"""Objects by name or import path; recipes, which use it, are tested in test_options.py."""

from pathlib import Path

import pytest

from registration.errors import InputError
from registration.import_paths import load_named

TABLE = {"three": lambda: 3}


def test_a_name_an_import_path_or_the_object_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numbers_of_mine.py").write_text("def seven():\n    return 7\n")
    monkeypatch.chdir(tmp_path)
    assert load_named("three", TABLE, int, title="number") == 3
    assert load_named("numbers_of_mine:seven", TABLE, int, title="number") == 7
    assert load_named(5, TABLE, int, title="number") == 5


@pytest.mark.parametrize(
    ("name", "got"), [("four", "the name four"), ("os:getcwd", "returns str"), ("os:absent", "AttributeError")]
)
def test_others_are_refused(name: str, got: str) -> None:
    with pytest.raises(InputError, match="no such number") as refused:
        load_named(name, TABLE, int, title="number")
    assert got in refused.value.got and "three" in refused.value.expected


def test_what_a_function_refuses_is_reported_as_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imports, function = "from registration.fit.recipes import Recipe", "def none():"
    body = "    return Recipe(name='mine', stages=(), levels=0)"
    (tmp_path / "recipe_of_mine.py").write_text("\n".join([imports, function, body]))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="number of the recipe is out of range") as refused:
        load_named("recipe_of_mine:none", TABLE, int, title="number")
    assert refused.value.where == "recipe mine, levels" and refused.value.got == "0"
