"""One multi-view capture of a human head in, one registration (a mesh in the model's topology) out.

The public names below are imported on first use: `import registration` loads neither torch nor the renderer.
"""

import os
from typing import TYPE_CHECKING

from registration.lazy_imports import attach

# Torch's threads spin after each operation by default and take the cores from the renderer's threads (and from every
# other process): steps were measured up to six times slower. Must be set before torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from registration.capture.native import read_capture
    from registration.doctor.report import CaptureReport, check_capture
    from registration.errors import InputError
    from registration.evaluate.evaluation import RegistrationEvaluation, evaluate_registration
    from registration.fit.recipes import Lengths, OffsetRegion, Rate, Recipe, Stage, Weights, load_recipe
    from registration.landmark_fit.fit import fit_landmarks
    from registration.landmark_fit.observations import Observations
    from registration.landmark_fit.options import FitOptions
    from registration.landmark_fit.result import LandmarkFit
    from registration.model.gnm import GNM
    from registration.model.gnm_npz import GNMData
    from registration.model.gnm_npz import read as load_model
    from registration.options import RegisterOptions
    from registration.pipeline import register
    from registration.progress import console_progress
    from registration.storage.registration_folder import load_registration, save_registration
    from registration.types import Camera, Capture, Parameters, Registration, View

__all__ = [
    "Camera",
    "Capture",
    "CaptureReport",
    "FitOptions",
    "GNM",
    "GNMData",
    "InputError",
    "LandmarkFit",
    "Lengths",
    "Observations",
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
    "fit_landmarks",
    "load_model",
    "load_recipe",
    "load_registration",
    "read_capture",
    "register",
    "save_registration",
]

__getattr__, __dir__ = attach(__name__, __file__)
