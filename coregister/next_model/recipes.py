"""Recipes of model building: the settings of `coregister.next_model.build.build_model`, by name.

A recipe is a function that returns a frozen `ModelRecipe`. The defaults of the settings classes are those of
`few_registrations`, the default of `gnmreg coregister --model-recipe` and of `build_model`; the resolved settings are
saved in the manifest of every model. Measurements: docs/model_building.md.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from coregister.next_model.alignment import AlignmentSettings
from coregister.next_model.completion import CompletionSettings
from coregister.next_model.expression import ExpressionSettings
from coregister.next_model.identity import IdentitySettings
from registration.import_paths import load_named
from registration.storage.records import structure


@dataclass(frozen=True, kw_only=True)
class ModelRecipe:
    """All settings of model building, except the data."""

    name: str
    alignment: AlignmentSettings = AlignmentSettings()
    completion: CompletionSettings = CompletionSettings()
    identity: IdentitySettings = IdentitySettings()
    expressions: ExpressionSettings = ExpressionSettings()
    memory_gb: float = 4.0  # of one covariance matrix, or of what replaces it

    def to_json(self) -> dict[str, Any]:
        """Return the settings as a JSON object, which `from_json` reads."""
        return asdict(self)

    @classmethod
    def from_json(cls, value: Any, *, where: object) -> "ModelRecipe":
        """Read what `to_json` returned.

        Args:
            value: a JSON value.
            where: names its origin in messages.

        Raises:
            InputError: a field is missing, unknown or of a wrong type.
        """
        recipe: ModelRecipe = structure(value, cls, where=where, title="recipe of the model")
        return recipe


def few_registrations() -> ModelRecipe:
    """Return the settings for tens of registered subjects: vertices weighted by area, cross-validated shrinkage towards
    the previous model, 0.999 of the variance."""
    return ModelRecipe(name="few_registrations")


def true_meshes() -> ModelRecipe:
    """Return the settings for meshes in exact correspondence, such as synthetic ones: vertices weighted equally, a
    shrinkage of 0.2, 0.99 of the variance."""
    identity = IdentitySettings(variance_ratio=0.99, shrinkage=0.2, by_area=False)
    return replace(few_registrations(), name="true_meshes", identity=identity)


MODEL_RECIPES: Mapping[str, Callable[[], ModelRecipe]] = {
    "few_registrations": few_registrations,
    "true_meshes": true_meshes,
}
DEFAULT_MODEL_RECIPE = "few_registrations"


def load_model_recipe(recipe: str | ModelRecipe) -> ModelRecipe:
    """Return the recipe of a name or import path.

    Args:
        recipe: a key of `MODEL_RECIPES`; `module:function`, the import path of a function that returns a ModelRecipe;
            or a ModelRecipe, which is returned as it is.

    Raises:
        InputError: as `registration.import_paths.load_named`.
    """
    return load_named(recipe, MODEL_RECIPES, ModelRecipe, title="model recipe")
