"""The options of registrations in the arguments of jobs: one JSON object."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from registration.errors import InputError
from registration.fit.recipes import RECIPES, load_recipe, named_recipe
from registration.options import DETECTOR, RegisterOptions
from registration.storage.records import structure


def to_job(options: RegisterOptions) -> RegisterOptions:
    """Return the options as jobs carry them: a recipe of an import path is replaced by its values.

    Raises:
        InputError: there is no such recipe, or landmark files are given, which a worker may not have.
    """
    if options.landmark_files:
        raise InputError(
            "Jobs cannot name landmark files",
            where="landmarks",
            expected="none: workers use the files next to the model",
            got=", ".join(map(str, options.landmark_files.values())),
            fix="put the landmark files next to the model",
        )
    recipe = load_recipe(options.recipe)
    return options if options.recipe in RECIPES else replace(options, recipe=recipe)


def from_job(value: Mapping[str, Any] | None) -> RegisterOptions:
    """Return the options in a job's arguments, from an untrusted source; None: the defaults.

    Raises:
        InputError: a field is unknown or has a wrong type; the recipe or the detector is an import path, which would
            run code of the sender's; or landmark files are named, which could lie anywhere.
    """
    options: RegisterOptions = structure(value or {}, RegisterOptions, where="options", title="options of a job")
    if isinstance(options.recipe, str):
        named_recipe(options.recipe)
    if options.detector != DETECTOR:  # the only one, whose name needs no import of what it computes with
        raise InputError(
            "There is no such landmark provider",
            where="detector",
            expected=DETECTOR,
            got=options.detector,
            fix="choose one of them",
        )
    return to_job(options)
