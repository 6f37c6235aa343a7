"""Many registrations in, a head model out; and measures of how good a model is.

The public names below are imported on first use: `import coregister` loads neither torch nor the renderer.
"""

from typing import TYPE_CHECKING

from registration.lazy_imports import attach

if TYPE_CHECKING:
    from coregister.evaluate.evaluation import EvaluationSettings, HeldOutSubject, ModelEvaluation
    from coregister.evaluate.evaluation import evaluate as evaluate_models
    from coregister.first_model.build import bootstrap
    from coregister.next_model.build import BuiltModel, build_model
    from coregister.next_model.recipes import ModelRecipe, load_model_recipe
    from coregister.next_model.training_data import TrainingMesh, TrainingSubject
    from coregister.stopping_rule import StoppingRule

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

__getattr__, __dir__ = attach(__name__, __file__)
