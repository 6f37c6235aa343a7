"""Coefficients with their categories: what the networks are trained on."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from coregister.sampler.categories import Factor
from registration.errors import InputError

MIN_PER_CATEGORY = 2  # a category of one sample has no variance to learn
HELD_OUT_SHARE = 0.1  # of the subjects


@dataclass(frozen=True, kw_only=True, eq=False)
class CoefficientSet:
    """Coefficients of registrations, and the categories that each belongs to.

    N samples, D coefficients, F factors.
    """

    coefficients: Float[np.ndarray, "N D"]
    categories: Int[np.ndarray, "N F"]  # indices into the factors' categories
    factors: tuple[Factor, ...]
    subjects: tuple[str, ...]
    identities: Float[np.ndarray, "N I"] | None = None  # of expressions: the coefficients of those who make them

    def rows(self, members: Bool[np.ndarray, "N"]) -> "CoefficientSet":
        """Return the set of some samples, with the same factors."""
        return CoefficientSet(
            coefficients=self.coefficients[members],
            categories=self.categories[members],
            factors=self.factors,
            subjects=tuple(name for name, kept in zip(self.subjects, members.tolist(), strict=True) if kept),
            identities=None if self.identities is None else self.identities[members],
        )

    @property
    def classes(self) -> dict[tuple[str, ...], Bool[np.ndarray, "N"]]:
        """Return the members of each combination of categories that occurs, in the order of the categories."""
        found = np.unique(self.categories, axis=0)
        return {
            tuple(f.categories[k] for f, k in zip(self.factors, row, strict=True)): (self.categories == row).all(1)
            for row in found.tolist()
        }

    def counts(self, factor: int) -> dict[str, int]:
        """Return the number of samples of each category of a factor."""
        counts = np.bincount(self.categories[:, factor], minlength=len(self.factors[factor].categories))
        return dict(zip(self.factors[factor].categories, counts.tolist(), strict=True))


def coefficient_set(
    coefficients: Float[np.ndarray, "N D"],
    names: Sequence[tuple[str, ...]],
    factors: Sequence[str],
    subjects: Sequence[str],
    where: object,
) -> CoefficientSet:
    """Return a set whose factors have the categories that occur, in alphabetical order.

    Args:
        coefficients: of the samples.
        names: category of each sample, by factor.
        factors: names of the factors.
        subjects: of the samples.
        where: what they were read from, for messages.

    Raises:
        InputError: a factor has one category or none; there are fewer samples than categories; a category has a single
            sample; coefficients are not finite.
    """
    known = []
    for k, factor in enumerate(factors):
        counts = Counter(row[k] for row in names)
        if len(counts) < 2:
            got = f"only {next(iter(counts))}" if counts else "no sample"
            raise _too_few(where, f"{factor}: at least two categories", got)
        if len(names) < 2 * len(counts):
            raise _too_few(
                where, f"{factor}: at least twice as many samples as categories", f"{len(names)} for {len(counts)}"
            )
        rare = sorted(name for name, count in counts.items() if count < MIN_PER_CATEGORY)
        if rare:
            raise _too_few(
                where, f"{factor}: at least {MIN_PER_CATEGORY} samples of each category", f"1 of {', '.join(rare)}"
            )
        known.append(Factor(name=factor, categories=tuple(sorted(counts))))
    if not np.isfinite(coefficients).all():
        what = "The coefficients are not finite"
        got = f"{int((~np.isfinite(coefficients)).any(1).sum())} samples with others"
        raise InputError(what, where=where, expected="finite numbers", got=got, fix="leave these samples out")
    indices = [[f.categories.index(name) for f, name in zip(known, row, strict=True)] for row in names]
    return CoefficientSet(
        coefficients=np.asarray(coefficients, np.float32),
        categories=np.array(indices, np.int64).reshape(len(names), len(known)),
        factors=tuple(known),
        subjects=tuple(subjects),
    )


def split_by_subject(samples: CoefficientSet, seed: int) -> tuple[CoefficientSet, CoefficientSet]:
    """Split into training and held-out samples, of different subjects.

    Every category keeps a training sample: a subject whose absence would take a category's last one is not held out.

    Args:
        samples: to be split.
        seed: of the choice of subjects.
    """
    names, subject = np.unique(np.array(samples.subjects), return_inverse=True)
    order = np.random.default_rng([17, seed]).permutation(len(names))
    wanted = round(HELD_OUT_SHARE * len(names))
    lengths = [len(factor.categories) for factor in samples.factors]
    left = [np.bincount(column, minlength=n) for column, n in zip(samples.categories.T, lengths, strict=True)]
    rows_of = np.split(np.argsort(subject, kind="stable"), np.cumsum(np.bincount(subject))[:-1])
    held = np.zeros(len(names), bool)
    for number in order.tolist():
        if held.sum() >= wanted:
            break
        own = samples.categories[rows_of[number]]
        after = [have - np.bincount(column, minlength=len(have)) for have, column in zip(left, own.T, strict=True)]
        if all((counts > 0).all() for counts in after):
            left, held[number] = after, True
    members = held[subject]
    return samples.rows(~members), samples.rows(members)


def _too_few(where: object, expected: str, got: str) -> InputError:
    what = "There are too few samples for these categories"
    fix = "add registrations with these tags, merge rare categories, or leave the factor out"
    return InputError(what, where=where, expected=expected, got=got, fix=fix)
