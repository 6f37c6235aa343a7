"""Many registrations in, a head model out; and measures of how good a model is.

The public names below are imported on first use: `import coregister` loads neither torch nor the renderer.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coregister.evaluate.evaluation import EvaluationSettings, HeldOutSubject, ModelEvaluation
    from coregister.evaluate.evaluation import evaluate as evaluate_models
    from coregister.first_model.build import bootstrap
    from coregister.next_model.build import BuiltModel, build_model
    from coregister.next_model.recipes import ModelRecipe, load_model_recipe
    from coregister.next_model.training_data import TrainingMesh, TrainingSubject
    from coregister.stopping_rule import Rule as StoppingRule

__all__ = [
    "BuiltModel",
    "EvaluationSettings",
    "HeldOutSubject",
    "ModelEvaluation",
    "ModelRecipe",
    "StoppingRule",
    "TrainingMesh",
    "TrainingSubject",
    "bootstrap",
    "build_model",
    "evaluate_models",
    "load_model_recipe",
]

_LOCATIONS = {  # public name -> where it is defined
    "BuiltModel": "coregister.next_model.build:BuiltModel",
    "EvaluationSettings": "coregister.evaluate.evaluation:EvaluationSettings",
    "HeldOutSubject": "coregister.evaluate.evaluation:HeldOutSubject",
    "ModelEvaluation": "coregister.evaluate.evaluation:ModelEvaluation",
    "ModelRecipe": "coregister.next_model.recipes:ModelRecipe",
    "StoppingRule": "coregister.stopping_rule:Rule",
    "TrainingMesh": "coregister.next_model.training_data:TrainingMesh",
    "TrainingSubject": "coregister.next_model.training_data:TrainingSubject",
    "bootstrap": "coregister.first_model.build:bootstrap",
    "build_model": "coregister.next_model.build:build_model",
    "evaluate_models": "coregister.evaluate.evaluation:evaluate",
    "load_model_recipe": "coregister.next_model.recipes:load_model_recipe",
}


def __getattr__(name: str) -> Any:
    if name not in _LOCATIONS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _LOCATIONS[name].partition(":")
    globals()[name] = value = getattr(importlib.import_module(module), attribute)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
