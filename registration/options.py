"""The options of a registration as one object, shared by the command line, the jobs of a farm and the library.

Imports neither torch nor NumPy: the command line shows these fields before anything heavy is loaded.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from registration.errors import InputError, check_seed
from registration.fit.recipes import Recipe


def _parse_landmark_files(pairs: list[str]) -> dict[str, Path]:
    """`SCHEME=FILE` arguments as a mapping."""
    files = {}
    for pair in pairs:
        scheme, _, file = pair.partition("=")
        if not (scheme and file):
            raise InputError(
                "Cannot read a landmark file argument",
                where="--landmarks",
                expected="SCHEME=FILE, e.g. 68=head_sparse_68.txt",
                got=pair,
                fix="write the scheme's name, an equals sign and the path of the model's landmark file",
            )
        files[scheme] = Path(file)
    return files


# How tyro reads and shows the two fields whose types it does not know.
_RECIPE: PrimitiveConstructorSpec[Any] = PrimitiveConstructorSpec(
    nargs=1,
    metavar="NAME",
    instance_from_str=lambda words: words[0],
    is_instance=lambda value: isinstance(value, (str, Recipe)),
    str_from_instance=lambda value: [value if isinstance(value, str) else value.name],
)
_LANDMARK_FILES: PrimitiveConstructorSpec[Any] = PrimitiveConstructorSpec(
    nargs="*",
    metavar="SCHEME=FILE ...",
    instance_from_str=_parse_landmark_files,
    is_instance=lambda value: isinstance(value, Mapping),
    str_from_instance=lambda value: [f"{scheme}={file}" for scheme, file in value.items()],
)
DETECTOR = "face478"
_LANDMARKS_ARGUMENT = arg(name="landmarks", help_behavior_hint="(optional)")


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """Everything about a registration that may be chosen, besides its capture, model, neutral and output folder.

    All of it decides the result (`registration.inputs.input_hash`).

    Attributes:
        recipe: Schedule of the fit. preview: seconds, small images. draft: minutes; shows whether a capture can be
            used. studio: full quality. in_model: the model's parameters alone, without free offsets. Or the import
            path MODULE:FUNCTION of a function that returns a Recipe.
        views: Use only this many views, at least 2, spread around the head.
        seed: Seed of the view subsets and of the silhouette samples.
        deterministic: Make every array equal from run to run on the CPU, in about twice the time.
        variant: Render on the CPU (llvm) or on an NVIDIA GPU (cuda).
        use_scan: Whether the capture's scan takes part in the fit. auto: its normals, in views without normal maps,
            and its surface, if no view has normal maps. always: its surface beside normal maps too. never: the scan
            is only measured, so that its distances judge the fit.
        detect: Landmarks are detected in the photographs where the capture lacks them or labels, and masks and labels
            made with them, unless this is switched off.
        stereo: Depths and normals are computed from the photographs where the capture has neither normals nor a scan,
            unless this is switched off.
        detector: The landmark provider: face478, or the import path MODULE:FUNCTION of a function that returns one.
        camera_sigma_px: Expected error of the given cameras: rms shift of the head in the stored images, pixels. Above
            0, the fit corrects poses and focal lengths, with this prior. 0: the cameras are exact.
        cranium: What a cranium that hair, a cap or missing cameras hide is like. model: as the auxiliary model beside
            the head model expects it with this face (`gnmreg model cranium`), if there is one. off: as the fit left it.
        landmark_files: The model's vertices of landmark schemes, instead of the files next to the model.
    """

    recipe: Annotated[str | Recipe, _RECIPE] = "draft"
    views: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    seed: Annotated[int, arg(metavar="S")] = 0
    deterministic: bool = False
    variant: Literal["llvm", "cuda"] = "llvm"
    use_scan: Literal["auto", "always", "never"] = "auto"
    detect: bool = True
    stereo: bool = True
    detector: Annotated[str, arg(metavar="NAME")] = DETECTOR
    camera_sigma_px: Annotated[float, arg(name="camera-sigma", metavar="PX")] = 0.0
    cranium: Literal["model", "off"] = "model"
    landmark_files: Annotated[Mapping[str, Path], _LANDMARK_FILES, _LANDMARKS_ARGUMENT] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if not (math.isfinite(self.camera_sigma_px) and self.camera_sigma_px >= 0):
            raise InputError(
                "The cameras' expected error is no distance",
                where="--camera-sigma",
                expected="pixels, at least 0",
                got=self.camera_sigma_px,
                fix="give the calibration's rms reprojection error, or 0 for exact cameras",
            )

    def arguments(self) -> list[str]:
        """Return the arguments of `gnmreg register` that give these options; defaults are omitted.

        A recipe that was passed as an object has no import path; its name stands for it.
        """
        words: list[str] = []
        default = RegisterOptions()
        for name, value in (("--recipe", self.recipe_name), ("--views", self.views), ("--seed", self.seed)):
            if value != getattr(default, name.removeprefix("--")):
                words += [name, str(value)]
        words += ["--deterministic"] if self.deterministic else []
        words += ["--variant", self.variant] if self.variant != default.variant else []
        words += ["--use-scan", self.use_scan] if self.use_scan != default.use_scan else []
        words += ["--no-detect"] if not self.detect else []
        words += ["--no-stereo"] if not self.stereo else []
        words += ["--detector", self.detector] if self.detector != default.detector else []
        words += ["--camera-sigma", f"{self.camera_sigma_px:g}"] if self.camera_sigma_px else []
        words += ["--cranium", self.cranium] if self.cranium != default.cranium else []
        if self.landmark_files:
            words += ["--landmarks", *(f"{scheme}={file}" for scheme, file in sorted(self.landmark_files.items()))]
        return words

    @property
    def recipe_name(self) -> str:
        """The recipe as it is shown: its name or import path."""
        return self.recipe if isinstance(self.recipe, str) else self.recipe.name
