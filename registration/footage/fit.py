"""`fit_footage`: an image, a folder of images, a capture or a video to the model's parameters, written to a folder."""

import shlex
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from registration.footage.media import Kind, recognize
from registration.footage.moment import read_moment
from registration.footage.moment_folder import FittedMoment, write_moment
from registration.footage.observed import Footage
from registration.footage.options import FootageOptions
from registration.footage.solve import KnownIdentity, read_identity, solver_options
from registration.inputs import read_schemes
from registration.landmark_fit.fit import fit_landmarks
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme
from registration.progress import NullProgress, Progress
from registration.storage import hashing
from registration.storage.registration_folder import check_output_folder, find_existing
from registration.types import Status

_NOT_HASHED = ("landmarks", "detector", "identity_from", "video", "meshes", "frames")  # their contents are, or nothing
_DEFAULTS = FootageOptions()


@dataclass(frozen=True, kw_only=True)
class FitOutcome:
    """How a fit ended."""

    status: Status
    reason: str
    notes: tuple[str, ...]


def fit_footage(
    source: Path,
    model: Path,
    out: Path,
    options: FootageOptions = _DEFAULTS,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> FitOutcome:
    """Fit the model to the landmarks of an input, and write a folder.

    Args:
        source: an image, a folder of images of one moment, or a capture.
        model: a GNM NPZ file; landmark schemes lie next to it.
        out: a registration folder; one that we wrote is replaced, one of the same inputs stays.
        options: of the fit.
        force: fit although `out` holds the result of the same inputs.
        progress: receives steps and messages.

    Raises:
        InputError: something cannot be used; nothing is written but, if no face is found, a picture of the search
            beside `out`.
    """
    progress = progress or NullProgress()
    source, out = Path(source), Path(out)
    kind = recognize(source)
    check_output_folder(out)
    data = gnm_npz.read(Path(model))
    schemes = read_schemes(Path(model), data, {})
    known = read_identity(options.identity_from, data)
    footage = read_moment(kind, source, schemes, options, out, progress)
    for note in footage.notes:
        progress.message(note)
    digests = _digests(footage, data, known)
    config = _config(kind, options)
    if not force and (same := find_existing(out, hashing.input_hash(digests, config))) is not None:
        progress.message(f"{out} already holds the fit of these inputs")
        return FitOutcome(status=same.status, reason=same.reason, notes=tuple(same.figures.get("notes", ())))
    progress.message(f"fitting {int(footage.observations.seen.sum())} landmarks")
    fit = fit_landmarks(footage.observations, data, solver_options(footage, options, known))
    progress.message("writing the page")
    registration = write_moment(
        FittedMoment(
            footage=footage,
            fit=fit,
            data=data,
            config=config,
            digests=digests,
            provenance=_provenance(source, Path(model), out, options),
        ),
        out,
    )
    return FitOutcome(status=fit.status, reason=fit.reason, notes=tuple(registration.figures["notes"]))


def _digests(footage: Footage, data: gnm_npz.GNMData, known: KnownIdentity | None) -> dict[str, str]:
    scheme: LandmarkScheme = footage.observations.scheme
    return {
        **footage.digests,
        "model": gnm_npz.content_hash(data),
        f"landmarks {scheme.name}": hashing.hash_fields(scheme),
        **({} if known is None else {"identity": known.digest}),
    }


def _config(kind: Kind, options: FootageOptions) -> dict[str, Any]:
    chosen = {f.name: getattr(options, f.name) for f in fields(options) if f.name not in _NOT_HASHED}
    return {"input": kind, **{name: hashing.to_jsonable(value) for name, value in chosen.items()}}


def _provenance(source: Path, model: Path, out: Path, options: FootageOptions) -> Mapping[str, str]:
    """The command that makes this fit, and the absolute paths in it."""
    paths = {"input": str(source.absolute()), "model": str(model.absolute())}
    words = ["gnmreg", "fit", paths["input"], "--model", paths["model"], "--out", str(out.absolute())]
    for f in fields(options):
        value = getattr(options, f.name)
        if f.default is MISSING or value == f.default:
            continue
        name = f.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no-{name}")
        else:
            words += [f"--{name}", str(value.absolute() if isinstance(value, Path) else value)]
    return {"command": shlex.join(words), **paths}
