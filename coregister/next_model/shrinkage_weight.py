"""Which share of the variance the previous model should have, asked of the people themselves: cross-validation."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

SHARES = tuple(round(0.05 * k, 2) for k in range(20))  # that are tried: 0 to 0.95
FOLDS = 10  # groups of subjects that are left out in turn, at most


def left_out_rms(
    gram: Float[np.ndarray, "M M"],
    members: Sequence[Int[np.ndarray, "N"]],
    centred: Sequence[bool],
    components: int,
    shares: Sequence[float] = SHARES,
) -> Float[np.ndarray, "P"]:
    """For each share of the previous model, what the first `components` leave of subjects that are left out: rms.

    All rows that there are, samples and then the previous model's components, enter by their products `gram` alone, in
    which every mean, component and remainder is a combination of rows: nothing is of a mesh's size.

    Args:
        members: for each kind of part (deviations; or symmetric and antisymmetric ones) the rows of the N subjects.
            All other rows are the previous model's.
        centred: whether that kind is about its mean, which is then taken anew without those left out, with N - 1.
    """
    count = len(members[0])
    own = np.concatenate(members)
    previous = np.eye(len(gram))[np.setdiff1d(np.arange(len(gram)), own)]
    squares = np.zeros(len(shares))
    for fold in range(min(FOLDS, count)):
        out = np.arange(count) % FOLDS == fold
        kept, tests = [], []
        for rows, about_mean in zip(members, centred, strict=True):
            unit = np.eye(len(gram))[rows]
            mean = unit[~out].mean(0) if about_mean else 0
            kept.append((unit[~out] - mean) / np.sqrt(max((~out).sum() - about_mean, 1)))
            tests.append(unit[out] - mean)
        samples, test = np.concatenate(kept), sum(tests)
        squares += [_squares(gram, samples, previous, share, components, test) for share in shares]
    return np.sqrt(squares / count)


def _squares(
    gram: Float[np.ndarray, "M M"],
    samples: Float[np.ndarray, "S M"],
    previous: Float[np.ndarray, "K M"],
    share: float,
    components: int,
    test: Float[np.ndarray, "T M"],
) -> float:
    """Sum over tests of the squared distance from the span of the mixture's first components."""
    energy, other = (float(np.einsum("sm,mn,sn->", rows, gram, rows)) for rows in (samples, previous))
    rows = np.concatenate([np.sqrt(1 - share) * samples, np.sqrt(share * energy / other) * previous])
    variance, vectors = np.linalg.eigh(rows @ gram @ rows.T)
    kept = np.flatnonzero(variance > 1e-11 * variance[-1])[-components:]
    basis = (vectors[:, kept] / np.sqrt(variance[kept])).T @ rows  # orthonormal in `gram`
    inside = test @ gram @ basis.T
    return float(np.einsum("tm,mn,tn->", test, gram, test) - (inside**2).sum())
