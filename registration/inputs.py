"""Everything that decides a registration: read, checked, and hashed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.anatomy.own_parts import FIGURE, OwnParts, found_alone
from registration.capture.jaw_order import has_reversed_jaw, with_corrected_jaw
from registration.capture.native import read_capture
from registration.capture.origin import capture_origin
from registration.capture.scan import Scan, read_scan
from registration.capture.triangulation import spreads_m, triangulate
from registration.completion.plan import CompletionPlan, plan_completion
from registration.cranium import auxiliary_model
from registration.cranium.auxiliary_model import CraniumModel
from registration.detect.providers import load_provider
from registration.doctor.ledger import Ledger
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.fit.initialization import MIN_LANDMARKS, select_spread_views
from registration.fit.recipes import Recipe, expression_recipe, load_recipe
from registration.fit.variables import pivot
from registration.geometry.topology import edges
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.jaw_order import SCHEME
from registration.model.landmarks import LandmarkScheme, check_topology, read_scheme, schemes_beside, shipped_schemes
from registration.model.regions import vertex_classes
from registration.options import RegisterOptions
from registration.storage import hashing
from registration.storage.registration_folder import load_registration
from registration.targets.classes import BACKGROUND
from registration.types import Capture, Registration

NOT_HASHED = {  # fields of the options that decide nothing by themselves, and why
    "landmark_files": "their contents are hashed as the schemes",
    "views": "the names of the selected views are hashed",
    "detect": "what is made is hashed",
    "stereo": "what is made is hashed",
    "detector": "its version is hashed where it is used",
    "cranium": "the auxiliary model is hashed where it is used",
}


@dataclass(frozen=True, kw_only=True)
class RegistrationInputs:
    """The inputs of a registration, read and checked."""

    capture: Capture  # with the selected views only, and its landmarks in the schemes' order
    ledger: Ledger  # of all views
    head_rows: Mapping[str, int] | None  # view's name -> height of the head, px of the stored image; None: unknown
    data: gnm_npz.GNMData
    schemes: Mapping[str, LandmarkScheme]
    origin: Float[np.ndarray, "3"]  # world, m: the fit's own world has its origin here
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]]  # triangulated, world; of the shared schemes
    plan: CompletionPlan  # of what the capture lacks
    landmark_spread_m: Mapping[str, Float[np.ndarray, "L"]]  # of these along each axis, where detectors state theirs
    recipe: Recipe
    camera_sigma_px: float  # expected error of the given cameras, px of the stored images; 0: they are exact
    neutral: Registration | None
    cranium: CraniumModel | None  # that completes a hidden cranium; None: the fit's own, or the neutral's
    scan: Scan | None  # whose normals stand in for normal maps, or whose surface is fitted; None: neither
    fits_scan: bool  # whether its surface is fitted
    digests: Mapping[str, str]  # input -> sha256
    config: Mapping[str, Any]  # the resolved options; decide the result together with the digests
    notes: tuple[str, ...]  # what is not used, or was read in another way than it is in the files

    @property
    def input_hash(self) -> str:
        """The `input_hash` of these inputs."""
        return hashing.input_hash(self.digests, self.config)


def read_inputs(
    capture_path: Path, model_path: Path, options: RegisterOptions, neutral: Path | None = None
) -> RegistrationInputs:
    """Read and check the inputs of a registration; landmarks are triangulated.

    Args:
        capture_path: a native capture folder.
        model_path: a GNM NPZ file; landmark schemes lie next to it.
        options: of the registration.
        neutral: folder of the subject's neutral registration, if the fit starts from one.

    Raises:
        InputError: something cannot be used.
    """
    recipe = load_recipe(options.recipe)
    capture = read_capture(capture_path)
    ledger = validate_capture(capture, use_scan=options.use_scan != "never")
    selected = _select_views(capture, options.views)
    data = gnm_npz.read(model_path)
    _check_model(data)
    start = None
    if neutral is not None:
        start = load_registration(neutral)
        _check_topology(start, data, neutral, model_path)
        _check_subject(start, neutral, capture)
    every = read_schemes(model_path, data, options.landmark_files)
    cranium = None if start is not None else used_cranium(model_path, data, options)
    digests, config = _deciding(capture, data, every, start, options, cranium)
    if start is not None:  # all expressions start from the same teeth, whether or not they were shared since
        start = found_alone(start, data, OwnParts.of(data), every)
    plan = completion_plan(selected, every, options)
    schemes = used_schemes(every, capture, detected=load_provider(options.detector).scheme if plan.landmarks else None)
    landmarks = triangulated_landmarks(selected, schemes)
    if not plan.landmarks:
        _check_head_can_be_found(selected, landmarks)
    scan = _scan_of_the_fit(selected, options)
    return RegistrationInputs(
        capture=selected,
        ledger=ledger,
        head_rows=ledger.head_rows,
        data=data,
        schemes=schemes,
        origin=capture_origin([view.camera for view in capture.views]),
        landmarks=landmarks,
        plan=plan,
        landmark_spread_m=spreads_m(selected, landmarks),
        recipe=recipe if start is None else expression_recipe(recipe),
        camera_sigma_px=options.camera_sigma_px,
        neutral=start,
        cranium=cranium,
        scan=scan,
        fits_scan=scan is not None
        and (options.use_scan == "always" or not any(view.has_normals for view in selected.views)),
        digests=digests,
        config=config,
        notes=(*_of_the_scan(capture), *data.remarks, *_reversed_files(capture, schemes)),
    )


def used_cranium(model_path: Path, data: gnm_npz.GNMData, options: RegisterOptions) -> CraniumModel | None:
    """Return the auxiliary model beside a head model, if there is one and the options want it.

    Raises:
        InputError: it cannot be read, or has another topology.
    """
    return auxiliary_model.find(model_path, data) if options.cranium == "model" else None


def read_schemes(model_path: Path, data: gnm_npz.GNMData, files: Mapping[str, Path]) -> dict[str, LandmarkScheme]:
    """Return the landmark schemes of a model, by name: shipped maps, those next to its file, and those in `files`.

    Of schemes of one name the latter count.

    Raises:
        InputError: a file that cannot be read as a scheme of this model.
    """
    template = data.template_vertex_positions
    given = {name: read_scheme(file, template, name) for name, file in files.items()}
    schemes = shipped_schemes(data) | schemes_beside(model_path, template) | given
    for name, scheme in schemes.items():
        check_topology(scheme, data, files.get(name, model_path))
    return schemes


def completion_plan(
    capture: Capture, schemes: Mapping[str, LandmarkScheme], options: RegisterOptions
) -> CompletionPlan:
    """Return what a registration makes of what the capture lacks. Raises InputError if there is no such detector."""
    return plan_completion(
        capture,
        schemes,
        detected=load_provider(options.detector).scheme if options.detect else None,
        stereo=options.stereo,
        use_scan=options.use_scan != "never",
    )


def used_schemes(
    schemes: Mapping[str, LandmarkScheme], capture: Capture, *, detected: str | None = None
) -> dict[str, LandmarkScheme]:
    """Return the schemes that count in a registration: all but shipped maps of landmarks that the capture lacks.

    Args:
        schemes: of the model.
        capture: with its own landmarks.
        detected: scheme of landmarks that will be detected, if any.
    """
    captured = {name for view in capture.views for name in view.landmarks} | {detected}
    return {name: scheme for name, scheme in schemes.items() if not scheme.shipped or name in captured}


def input_hash(
    capture: Capture,
    data: gnm_npz.GNMData,
    schemes: Mapping[str, LandmarkScheme],
    neutral: Registration | None,
    options: RegisterOptions,
    cranium: CraniumModel | None = None,
) -> str:
    """Return the sha256 of all that decides a registration: equal for two that must have equal results.

    It covers every field of these objects but those that `hashing.NOT_HASHED` lists with a reason, and the version of
    this package.

    Args:
        capture: with all its views; `options.views` selects from them.
        data: the head model.
        schemes: of the model, as `read_schemes` returns them.
        neutral: the subject's neutral registration that the fit starts from, if any.
        options: of the registration; the recipe is hashed by its values, not by its name.
        cranium: what `used_cranium` returns for a registration without a neutral, if any.

    Raises:
        InputError: there is no such recipe, or `options.views` is below 2.
    """
    return hashing.input_hash(*_deciding(capture, data, schemes, neutral, options, cranium))


def _deciding(
    capture: Capture,
    data: gnm_npz.GNMData,
    schemes: Mapping[str, LandmarkScheme],
    neutral: Registration | None,
    options: RegisterOptions,
    cranium: CraniumModel | None,
) -> tuple[dict[str, str], dict[str, Any]]:
    """Digests of the inputs, and the resolved options as JSON values."""
    recipe, selected = load_recipe(options.recipe), _select_views(capture, options.views)
    digests = {"capture": hashing.hash_capture(selected), "model": gnm_npz.content_hash(data)}
    plan = completion_plan(selected, schemes, options)
    detected = None
    if plan.landmarks:
        provider = load_provider(options.detector)
        detected, digests["detector"] = provider.scheme, provider.version
    used = used_schemes(schemes, capture, detected=detected)
    digests |= {f"landmarks {name}": hashing.hash_fields(scheme) for name, scheme in used.items()}
    if cranium is not None:
        digests["cranium"] = hashing.hash_fields(cranium)
    if neutral is not None:
        digests["neutral"] = neutral.figures.get(FIGURE, {}).get("digest") or hashing.hash_fields(neutral)
        recipe = expression_recipe(recipe)
    chosen = replace(options, recipe=recipe)
    config = {name: hashing.to_jsonable(value) for name, value in hashing.hashed_fields(chosen, NOT_HASHED).items()}
    return digests, {**config, "views": [view.name for view in selected.views], "made": list(plan.channels)}


def _reversed_files(capture: Capture, schemes: Mapping[str, LandmarkScheme]) -> tuple[str, ...]:
    """The user's files whose jaw is in the reverse order, if any."""
    files = [f"the model's scheme {name}" for name, scheme in schemes.items() if scheme.reversed_in_file]
    files += ["the capture's landmarks 68"] if SCHEME in schemes and has_reversed_jaw(capture) else []
    order = "points 2-6 of the right jaw in reverse, as Google's first file had them; read in the scheme's order"
    return tuple(f"{file}: {order}" for file in files)


def _select_views(capture: Capture, count: int | None) -> Capture:
    """The capture with only `count` views, spread around the head; with all of them for None.

    Its landmarks are in the order of the model's schemes.
    """
    capture = with_corrected_jaw(capture)
    if count is None:
        return capture
    if count < 2:
        raise InputError("Too few views", where="views", expected="at least 2", got=count, fix="use at least two views")
    selected = select_spread_views([view.camera for view in capture.views], count)
    return replace(capture, views=tuple(capture.views[i] for i in selected))


def _of_the_scan(capture: Capture) -> tuple[str, ...]:
    """What was found in the scan that a capture was made from (`scan_capture.make`)."""
    notes = capture.tags.get("scan_notes", ())
    return tuple(map(str, notes)) if isinstance(notes, (list, tuple)) else ()


def _scan_of_the_fit(capture: Capture, options: RegisterOptions) -> Scan | None:
    """The scan if the fit uses its normals or its surface."""
    if capture.scan is None or options.use_scan == "never":
        return None
    needed = options.use_scan == "always" or not all(view.has_normals for view in capture.views)
    return read_scan(capture.scan) if needed else None


def triangulated_landmarks(
    capture: Capture, schemes: Mapping[str, LandmarkScheme]
) -> dict[str, Float[np.ndarray, "L 3"]]:
    """Return triangulated landmarks (world, metres; NaN: failed) of every scheme that capture and model share.

    Raises:
        InputError: a scheme has another length in the capture.
    """
    landmarks = {}
    for name in sorted({name for view in capture.views for name in view.landmarks} & set(schemes)):
        landmarks[name] = triangulate(capture, name)[0]
        expected = len(schemes[name].indices)
        if len(landmarks[name]) != expected:
            raise InputError(
                "Landmarks of another length than the model's scheme",
                where=f"scheme {name} of {capture.root}",
                expected=f"{expected} landmarks",
                got=len(landmarks[name]),
                fix=f"name the scheme otherwise, or give the model's with --landmarks {name}=FILE",
            )
    return landmarks


def _check_model(data: gnm_npz.GNMData) -> None:
    """Raise now what the fit would trip over: missing vertex groups or components, a mesh that is no manifold."""
    vertex_classes(data)
    pivot(data)
    texture_atlas(data)
    edges(data.triangles)


def _check_head_can_be_found(capture: Capture, landmarks: Mapping[str, Float[np.ndarray, "L 3"]]) -> None:
    counts = {name: int(np.isfinite(points).all(1).sum()) for name, points in landmarks.items()}
    labelled = BACKGROUND in capture.classes and any(view.segmentation for view in capture.views)
    located = labelled or capture.head is not None or any(view.mask for view in capture.views)
    if max(counts.values(), default=0) < MIN_LANDMARKS and not located:
        triangulated = [f"{count} triangulated of scheme {name}" for name, count in counts.items()]
        raise InputError(
            "The head cannot be located",
            where=capture.root,
            expected=f"{MIN_LANDMARKS} landmarks of a scheme that the model has, or masks",
            got=", ".join([*(triangulated or ["no landmarks of a scheme that the model has"]), "no masks"]),
            fix="add masks (or label maps with a background), landmarks, or the model's landmarks with --landmarks",
        )


def _check_topology(neutral: Registration, data: gnm_npz.GNMData, neutral_path: Path, model_path: Path) -> None:
    same = gnm_npz.topology_hash(neutral.triangles) == gnm_npz.topology_hash(data.triangles)
    sizes = (len(neutral.identity), len(neutral.expression), len(neutral.vertices))
    expected = (len(data.vertex_identity_basis), len(data.expression_basis), len(data.template_vertex_positions))
    if not same or sizes != expected:
        raise InputError(
            "The neutral was registered with another model",
            where=neutral_path,
            expected=f"identity, expression, vertices {expected} and the triangles of {model_path}",
            got=f"{sizes}, {'the same' if same else 'other'} triangles",
            fix="register the neutral with this model first",
        )


def _check_subject(neutral: Registration, neutral_path: Path, capture: Capture) -> None:
    shown = neutral.figures.get("subject", capture.subject)
    if shown != capture.subject:
        raise InputError(
            "The neutral shows another subject",
            where=neutral_path,
            expected=f"a registration of {capture.subject}, as in {capture.root / 'capture.toml'}",
            got=shown,
            fix="give this subject's neutral, or correct `subject` in capture.toml and register the neutral again",
        )
