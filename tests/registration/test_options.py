"""Options, recipes by import path, and the options that enter the input hash."""

import dataclasses
from dataclasses import field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro

from registration.errors import InputError
from registration.fit.recipes import RECIPES, OffsetRegion, Rate, Stage, Weights, draft, load_recipe, preview
from registration.inputs import NOT_HASHED, input_hash
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme
from registration.options import RegisterOptions
from registration.storage import hashing
from registration.types import Camera, Capture, View
from tests.conftest import FIXTURES
from tests.registration.report.test_page import a_registration


def parsed(words: str) -> RegisterOptions:
    return tyro.cli(RegisterOptions, args=words.split())


def test_the_command_line_sets_every_field() -> None:
    assert parsed("") == RegisterOptions()
    words = "--recipe my:own --views 3 --seed 4 --deterministic --variant cuda --camera-sigma 0.5"
    assert parsed(f"{words} --landmarks 68=a.txt 5=b=c.txt") == RegisterOptions(
        recipe="my:own",
        camera_sigma_px=0.5,
        views=3,
        seed=4,
        deterministic=True,
        variant="cuda",
        landmark_files={"68": Path("a.txt"), "5": Path("b=c.txt")},
    )


def test_help_shows_every_field_with_its_docstring(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit):
        parsed("--help")
    text = capsys.readouterr().out
    for option in ("recipe NAME", "views N", "seed S", "deterministic", "variant", "landmarks"):
        assert f"--{option}" in text
    assert "SCHEME=FILE" in text and "spread around the head" in text and "(default: draft)" in text


@pytest.mark.parametrize("sigma_px", [-0.1, float("nan"), float("inf")])
def test_a_sigma_that_is_no_distance_is_refused(sigma_px: float) -> None:
    with pytest.raises(InputError, match="no distance"):
        RegisterOptions(camera_sigma_px=sigma_px)


def test_the_options_give_back_their_arguments() -> None:
    assert RegisterOptions(camera_sigma_px=0.75).arguments() == ["--camera-sigma", "0.75"]


@pytest.mark.parametrize("pair", ["68", "68=", "=file.txt"])
def test_malformed_landmark_pairs_are_refused(pair: str) -> None:
    with pytest.raises(InputError, match="landmark file argument"):
        parsed(f"--landmarks {pair}")


MODULE = """
from registration.fit.recipes import draft

def mine():
    return draft(scale=False)

def none():
    return None

def broken():
    return 1 / 0
"""


def test_a_recipe_is_a_name_an_import_path_or_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "recipes_of_mine.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    assert load_recipe("preview") == preview()
    assert load_recipe("recipes_of_mine:mine") == draft(scale=False) == load_recipe(draft(scale=False))
    assert RegisterOptions(recipe=draft()).recipe_name == "draft"


@pytest.mark.parametrize(
    ("name", "got"),
    [
        ("drafty", "drafty"),
        (":mine", ":mine"),
        ("no_such_module_here:mine", "ModuleNotFoundError"),
        ("other_recipes:absent", "AttributeError"),
        ("other_recipes:none", "NoneType"),
        ("other_recipes:broken", "ZeroDivisionError"),
        ("other_recipes:draft.x", "AttributeError"),
    ],
)
def test_unknown_recipes_are_refused(name: str, got: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other_recipes.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no such recipe") as refused:
        load_recipe(name)
    assert got in refused.value.got and all(known in refused.value.expected for known in RECIPES)


@pytest.fixture(scope="module")
def data() -> gnm_npz.GNMData:
    return gnm_npz.read(FIXTURES / "tiny_gnm.npz")


def a_view(folder: Path, number: int) -> View:
    image = folder / f"{number}.png"
    image.write_bytes(bytes([number]))
    pose = np.eye(4)
    pose[:3, 3] = [0.1 * number, 0, 1]
    camera = Camera(width_px=8, height_px=6, intrinsics=np.eye(3), T_cam_world=pose)
    return View(name=f"cam{number}", camera=camera, image=image)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return Capture(root=tmp_path, subject="s", expression="e", views=tuple(a_view(tmp_path, k) for k in range(4)))


@pytest.fixture
def scheme() -> LandmarkScheme:
    return LandmarkScheme(name="2", indices=np.array([[0, 1, 2], [1, 2, 3]]), weights=np.full((2, 3), 1 / 3))


def with_new_field(value: Any, content: object) -> Any:
    """The same dataclass with one more field, as a later version may have it."""
    cls = type(value)
    larger = make_dataclass(
        cls.__name__, [("added", object, field(kw_only=True))], bases=(cls,), frozen=True, kw_only=True
    )
    return larger(**{f.name: getattr(value, f.name) for f in fields(value)}, added=content)


def deciding(capture: Capture, scheme: LandmarkScheme) -> dict[str, Any]:
    return {
        "capture": capture,
        "schemes": {"2": scheme},
        "neutral": a_registration(),
        "options": RegisterOptions(recipe=draft()),
    }


def put(container: Any, path: str, change: Any) -> Any:
    """The dataclass, tuple or mapping with the item at a dotted path replaced by `change` of it."""
    head, _, rest = path.partition(".")
    step = (lambda item: put(item, rest, change)) if rest else change
    if isinstance(container, tuple):
        return tuple(step(item) if k == int(head) else item for k, item in enumerate(container))
    if isinstance(container, dict):
        return {**container, head: step(container[head])}
    return replace(container, **{head: step(getattr(container, head))})


@pytest.mark.parametrize(
    "path",
    [
        "capture",
        "capture.views.2",
        "capture.views.2.camera",
        "schemes.2",
        "neutral",
        "options",
        "options.recipe",
        "options.recipe.stages.1",
        "options.recipe.stages.1.weights",
        "options.recipe.stages.1.lengths",
        "options.recipe.regions.0",
    ],
)
def test_a_new_field_anywhere_changes_the_hash(
    path: str, capture: Capture, scheme: LandmarkScheme, data: gnm_npz.GNMData
) -> None:
    """No list has to be extended for it."""
    hashes = []
    for content in (1, 2):
        changed = put(deciding(capture, scheme), path, lambda value, content=content: with_new_field(value, content))
        hashes.append(input_hash(data=data, **changed))
    assert len(set(hashes)) == 2


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("capture.subject", "other"),
        ("capture.tags", {"held_out": True}),
        ("capture.views.0.camera.distortion", (0.1, 0.0, 0.0, 0.0)),
        ("schemes.2.weights", np.full((2, 3), 0.5)),
        ("neutral.identity", np.ones(1, np.float32)),
        ("options.views", 3),
        ("options.seed", 1),
        ("options.deterministic", True),
        ("options.variant", "cuda"),
        ("options.camera_sigma_px", 1.0),
        ("options.recipe.stages.0.weights", Weights(rgb=0.25)),
        ("options.recipe.stages.0.free", (("identity", Rate(start=1.0, end=0.5)),)),
        ("options.recipe.regions", (OffsetRegion(name="lips"),)),
    ],
)
def test_options_that_change_the_hash(
    path: str, value: object, capture: Capture, scheme: LandmarkScheme, data: gnm_npz.GNMData
) -> None:
    before = deciding(capture, scheme)
    assert input_hash(data=data, **put(before, path, lambda _: value)) != input_hash(data=data, **before)


def test_options_that_do_not_change_the_hash(
    capture: Capture, scheme: LandmarkScheme, data: gnm_npz.GNMData, tmp_path: Path
) -> None:
    before = deciding(capture, scheme)
    for path, value in (
        ("capture.root", tmp_path / "elsewhere"),
        ("capture.views", capture.views[::-1]),
        ("neutral.seconds", {"offsets": 3.0}),
        ("neutral.figures", {}),
        ("options.landmark_files", {"2": Path("a.txt")}),
        ("options.recipe", "draft"),
    ):
        if path != "capture.views":
            assert input_hash(data=data, **put(before, path, lambda _, v=value: v)) == input_hash(data=data, **before)
    assert hashing.hash_capture(capture) == hashing.hash_capture(replace(capture, views=capture.views[::-1]))


def test_fields_that_are_not_hashed_exist_and_have_a_reason() -> None:
    for kind, reasons in {**hashing.NOT_HASHED, RegisterOptions: NOT_HASHED}.items():
        assert set(reasons) <= {f.name for f in dataclasses.fields(kind)} and all(reasons.values())


def test_a_recipe_is_hashed_by_its_values(capture: Capture, data: gnm_npz.GNMData) -> None:
    stages = (*draft().stages[:-1], Stage(name="mine", steps=1, level=0))
    mine = RegisterOptions(recipe=replace(draft(), stages=stages))
    assert input_hash(capture, data, {}, None, mine) != input_hash(capture, data, {}, None, RegisterOptions())
