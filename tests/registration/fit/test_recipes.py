"""Recipes refuse numbers that no fit can use, and name them."""

from dataclasses import replace
from typing import Any

import pytest

from registration.errors import InputError
from registration.fit.recipes import RECIPES, Recipe, draft, expression_recipe


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"coarsest_head_px": -5}, "coarsest_head_px"),
        ({"finest_head_px": 0}, "finest_head_px"),
        ({"texture_px": 0}, "texture_px"),
        ({"slide_px": 0}, "slide_px"),
        ({"levels": 0}, "levels"),
        ({"levels": 2}, "level of stage model"),  # a stage of the draft has level 2
    ],
)
def test_a_size_out_of_range_is_refused(change: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=f"recipe draft, {named}"):
        replace(draft(), **change)


@pytest.mark.parametrize(("name", "got"), [("steps", 0), ("views_per_step", 0), ("level", 3), ("level", -1)])
def test_a_number_of_a_stage_out_of_range_is_refused(name: str, got: int) -> None:
    first, *others = draft().stages
    with pytest.raises(InputError, match=f"{name} of stage {first.name}"):
        replace(draft(), stages=(replace(first, **{name: got}), *others))


@pytest.mark.parametrize("name", RECIPES)
def test_named_recipes_are_in_range(name: str) -> None:
    recipe = RECIPES[name]()
    assert isinstance(recipe, Recipe) and isinstance(expression_recipe(recipe), Recipe)
