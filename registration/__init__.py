"""One multi-view capture of a human head in, one registration (a mesh in the model's topology) out.

The public names below are imported on first use: `import registration` loads neither torch nor the renderer.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

# Torch's threads spin after each operation by default and take the cores from the renderer's threads (and from every
# other process): steps were measured up to six times slower. Must be set before torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from registration.capture.doctor import CaptureReport, check_capture
    from registration.capture.native import read_capture
    from registration.errors import InputError
    from registration.evaluate.evaluation import Evaluation as RegistrationEvaluation
    from registration.evaluate.evaluation import evaluate as evaluate_registration
    from registration.fit.recipes import Lengths, OffsetRegion, Rate, Recipe, Stage, Weights, load_recipe
    from registration.model.gnm import GNM
    from registration.model.gnm_npz import GNMData
    from registration.model.gnm_npz import read as load_model
    from registration.options import RegisterOptions
    from registration.pipeline import register
    from registration.progress import shown as console_progress
    from registration.storage.registration_folder import load_registration, save_registration
    from registration.types import Camera, Capture, Parameters, Registration, View

__all__ = [
    "Camera",
    "Capture",
    "CaptureReport",
    "GNM",
    "GNMData",
    "InputError",
    "Lengths",
    "OffsetRegion",
    "Parameters",
    "Rate",
    "Recipe",
    "RegisterOptions",
    "Registration",
    "RegistrationEvaluation",
    "Stage",
    "View",
    "Weights",
    "check_capture",
    "console_progress",
    "evaluate_registration",
    "load_model",
    "load_recipe",
    "load_registration",
    "read_capture",
    "register",
    "save_registration",
]

_LOCATIONS = {  # public name -> where it is defined
    "Camera": "registration.types:Camera",
    "Capture": "registration.types:Capture",
    "CaptureReport": "registration.capture.doctor:CaptureReport",
    "GNM": "registration.model.gnm:GNM",
    "GNMData": "registration.model.gnm_npz:GNMData",
    "InputError": "registration.errors:InputError",
    "Lengths": "registration.fit.recipes:Lengths",
    "OffsetRegion": "registration.fit.recipes:OffsetRegion",
    "Parameters": "registration.types:Parameters",
    "Rate": "registration.fit.recipes:Rate",
    "Recipe": "registration.fit.recipes:Recipe",
    "RegisterOptions": "registration.options:RegisterOptions",
    "Registration": "registration.types:Registration",
    "RegistrationEvaluation": "registration.evaluate.evaluation:Evaluation",
    "Stage": "registration.fit.recipes:Stage",
    "View": "registration.types:View",
    "Weights": "registration.fit.recipes:Weights",
    "check_capture": "registration.capture.doctor:check_capture",
    "console_progress": "registration.progress:shown",
    "evaluate_registration": "registration.evaluate.evaluation:evaluate",
    "load_model": "registration.model.gnm_npz:read",
    "load_recipe": "registration.fit.recipes:load_recipe",
    "load_registration": "registration.storage.registration_folder:load_registration",
    "read_capture": "registration.capture.native:read_capture",
    "register": "registration.pipeline:register",
    "save_registration": "registration.storage.registration_folder:save_registration",
}


def __getattr__(name: str) -> Any:
    if name not in _LOCATIONS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _LOCATIONS[name].partition(":")
    globals()[name] = value = getattr(importlib.import_module(module), attribute)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
