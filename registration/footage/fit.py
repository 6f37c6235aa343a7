"""`fit_footage`: an image, a folder of images, a capture or a video to the model's parameters, written to a folder."""

import shlex
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.footage.media import Kind, recognize
from registration.footage.moment import read_moment
from registration.footage.moment_folder import FittedMoment, write_moment
from registration.footage.observed import Footage
from registration.footage.options import FootageOptions
from registration.footage.sequence import read_sequence_footage
from registration.footage.sequence_folder import (
    FittedSequence,
    check_mesh_frames,
    check_sequence_folder,
    find_sequence,
    write_sequence,
)
from registration.footage.solve import KnownIdentity, read_identity, solver_options
from registration.footage.video import Video, open_video
from registration.footage.windows import fit_long
from registration.inputs import read_schemes
from registration.landmark_fit.fit import fit_landmarks
from registration.landmark_fit.options import ExpressionPrior
from registration.landmark_fit.prior import read_expression_prior
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme
from registration.progress import NullProgress, Progress
from registration.storage import hashing
from registration.storage.registration_folder import check_output_folder, find_existing
from registration.types import Status

_NOT_HASHED = ("landmarks", "detector", "identity_from")  # their contents are
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
        source: an image, a folder of images of one moment, a capture, or a video.
        model: a GNM NPZ file; landmark schemes lie next to it.
        out: for one moment a registration folder, for a video a folder with `fit.npz`, a page and a video. One that we
            wrote is replaced, one of the same inputs stays.
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
    if kind == "video":
        check_sequence_folder(out)
    else:
        check_output_folder(out)
        _check_moment(options)
    if kind == "capture":
        _check_capture(options)
    data = gnm_npz.read(Path(model))
    schemes = read_schemes(Path(model), data, {})
    known = read_identity(options.identity_from, data)
    prior = read_expression_prior(Path(model), data, options.expression_sigma)
    video = open_video(source, options) if kind == "video" else None
    if video is None:
        footage = read_moment(kind, source, schemes, options, out, progress)
    else:
        footage = read_sequence_footage(source, video, schemes, options, out, progress)
        check_mesh_frames(footage, options)
    for note in footage.notes:
        progress.message(note)
    task = _Task(
        footage=footage,
        data=data,
        schemes=schemes,
        known=known,
        prior=prior,
        options=options,
        config=_config(kind, options),
        digests=_digests(footage, data, known, prior),
        provenance=_provenance(source, Path(model), out, options),
        out=out,
        progress=progress,
    )
    if not force and (same := task.existing()) is not None:
        progress.message(f"{out} already holds the fit of these inputs")
        return same
    count = len(footage.numbers)
    what = f"{int(footage.observations.seen.sum())} landmarks" + (f" in {count} frames" if count > 1 else "")
    progress.message(f"fitting {what}")
    return task.moment() if video is None else task.sequence(video)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Task:
    """A fit whose inputs have been read."""

    footage: Footage
    data: gnm_npz.GNMData
    schemes: Mapping[str, LandmarkScheme]  # of the model
    known: KnownIdentity | None
    prior: ExpressionPrior | None  # of the model's expressions
    options: FootageOptions
    config: Mapping[str, Any]
    digests: Mapping[str, str]
    provenance: Mapping[str, str]
    out: Path
    progress: Progress

    def existing(self) -> FitOutcome | None:
        """What `out` holds, if it was made from the same inputs."""
        digest = hashing.input_hash(self.digests, self.config)
        if self.footage.kind == "video":
            manifest = find_sequence(self.out, digest)
            return None if manifest is None else _outcome(manifest)
        same = find_existing(self.out, digest)
        if same is None:
            return None
        return FitOutcome(status=same.status, reason=same.reason, notes=tuple(same.figures.get("notes", ())))

    def moment(self) -> FitOutcome:
        """Fit and write one moment."""
        fit = fit_landmarks(
            self.footage.observations, self.data, solver_options(self.footage, self.options, self.known, self.prior)
        )
        self.progress.message("writing the page")
        fitted_scheme = self.footage.observations.scheme
        fitted = FittedMoment(
            footage=self.footage,
            fit=fit,
            data=self.data,
            schemes={name: one for name, one in self.schemes.items() if one is fitted_scheme or not one.shipped},
            config=self.config,
            digests=self.digests,
            provenance=self.provenance,
        )
        registration = write_moment(fitted, self.out)
        return FitOutcome(status=fit.status, reason=fit.reason, notes=tuple(registration.figures["notes"]))

    def sequence(self, video: Video) -> FitOutcome:
        """Fit and write a sequence."""
        fit = fit_long(
            self.footage.observations,
            self.data,
            solver_options(self.footage, self.options, self.known, self.prior),
            report=lambda done, total: self.progress.update(done, total, "solving windows"),
        )
        fitted = FittedSequence(
            footage=self.footage,
            video=video,
            fit=fit,
            data=self.data,
            options=self.options,
            config=self.config,
            digests=self.digests,
            provenance=self.provenance,
        )
        return _outcome(write_sequence(fitted, self.out, self.progress))


def _outcome(manifest: Mapping[str, Any]) -> FitOutcome:
    return FitOutcome(status=manifest["status"], reason=manifest["reason"], notes=tuple(manifest["figures"]["notes"]))


def _check_moment(options: FootageOptions) -> None:
    """Refuse options of videos for one moment. Raises InputError."""
    plain = FootageOptions()
    for name in ("every", "start", "end", "meshes", "frames", "temporal", "video"):
        if getattr(options, name) != getattr(plain, name):
            raise InputError(
                "The option is for videos only",
                where=f"--{'no-' if name in ('temporal', 'video') else ''}{name}",
                expected="a video as input",
                got="one moment",
                fix="leave it out; gnmreg export writes the mesh in other formats",
            )


def _check_capture(options: FootageOptions) -> None:
    """Refuse options of unknown cameras for a capture. Raises InputError."""
    for name in ("focal", "principal_point", "distortion"):
        if getattr(options, name) != getattr(_DEFAULTS, name):
            raise InputError(
                "The option is for unknown cameras only",
                where=f"--{name.replace('_', '-')}",
                expected="images or a video as input",
                got="a capture with calibrated cameras",
                fix="leave it out, or fit the folder of the capture's images",
            )


def _digests(
    footage: Footage, data: gnm_npz.GNMData, known: KnownIdentity | None, prior: ExpressionPrior | None
) -> dict[str, str]:
    scheme: LandmarkScheme = footage.observations.scheme
    return {
        **footage.digests,
        "model": gnm_npz.content_hash(data),
        f"landmarks {scheme.name}": hashing.hash_fields(scheme),
        **({} if known is None else {"identity": known.digest}),
        **({} if prior is None else {"expression prior": hashing.hash_fields(prior)}),
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
