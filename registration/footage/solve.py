"""From an input and its options to the options of the solver, and the known identity."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.calibrate.start import EXIF_SIGMA
from registration.errors import InputError
from registration.footage.observed import Footage
from registration.footage.options import FootageOptions
from registration.footage.sequence_file import FILE, read_sequence
from registration.landmark_fit.options import ExpressionPrior, FitOptions, TemporalPrior
from registration.model.gnm_npz import GNMData, topology_hash
from registration.storage.hashing import hash_arrays
from registration.storage.registration_folder import is_registration, load_registration

ALIKE = 10.0  # neighbouring detected landmarks err alike: so many count as one


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownIdentity:
    """A subject's identity, and offsets if its registration has some."""

    identity: Float[np.ndarray, "I"]
    offsets: Float[np.ndarray, "V 3"] | None

    @property
    def digest(self) -> str:
        """The sha256 of the arrays."""
        return hash_arrays(self.identity, *([] if self.offsets is None else [self.offsets]))


def read_identity(path: Path | None, data: GNMData) -> KnownIdentity | None:
    """Read the identity of a registration, or of a fitted sequence; None: there is none.

    Raises:
        InputError: it is neither, or was made with another model.
    """
    if path is None:
        return None
    offsets: np.ndarray | None = None
    if is_registration(path):
        registered = load_registration(path)
        identity = registered.identity.astype(np.float64)
        offsets = registered.offsets.astype(np.float64) if registered.offsets.any() else None
        same = topology_hash(registered.triangles) == topology_hash(data.triangles)
    elif (path / FILE).is_file():
        arrays = read_sequence(path / FILE)
        identity = arrays["identity"].astype(np.float64)
        same = arrays["expression"].shape[1] == len(data.expression_basis)
    else:
        raise InputError(
            "There is no identity",
            where=path,
            expected=f"a registration's folder, or one that gnmreg fit wrote, with {FILE}",
            got="neither" if path.exists() else "no such folder",
            fix="give such a folder to --identity-from",
        )
    if not same or len(identity) != len(data.vertex_identity_basis):
        raise InputError(
            "The identity is of another model",
            where=path,
            expected=f"{len(data.vertex_identity_basis)} identity coefficients and the model's topology",
            got=f"{len(identity)} coefficients" + ("" if same else ", another topology or expression basis"),
            fix="fit it with this model first",
        )
    return KnownIdentity(identity=identity, offsets=offsets)


def solver_options(
    footage: Footage, options: FootageOptions, known: KnownIdentity | None, prior: ExpressionPrior | None = None
) -> FitOptions:
    """Return the solver's options for an input."""
    plain = FitOptions()
    sequence = footage.kind == "video" and options.temporal
    return FitOptions(
        expression_sigma=options.expression_sigma,
        expression_prior=prior,
        focal_guess=plain.focal_guess if footage.focal_guess is None else footage.focal_guess,
        log_focal=plain.log_focal if footage.focal_guess is None else EXIF_SIGMA,
        principal_point=options.principal_point,
        distortion=options.distortion,
        temporal=temporal_prior(options.every) if sequence else None,
        correlated=ALIKE if footage.detected else 1.0,
        identity=None if known is None else known.identity,
        offsets=None if known is None else known.offsets,
    )


def temporal_prior(every: int) -> TemporalPrior:
    """Return how much changes from one used frame to the next, if every `every`th is used."""
    one, factor = TemporalPrior(), float(np.sqrt(every))
    return TemporalPrior(
        expression=factor * one.expression,
        rotation=factor * one.rotation,
        translation_m=factor * one.translation_m,
    )
