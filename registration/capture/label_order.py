"""Which known table explains label maps whose indices have no names: by where the parts of a face lie."""

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, UInt8

from registration.capture.class_names import BACKGROUND, UNLABELLED
from registration.capture.label_tables import TABLES, LabelTable

_MIN_FIT = 0.85  # of the relations that must hold, in the mean over maps
_FRONTAL = 3  # maps
_NEAR = 0.03  # below the best: as likely
_FEW = 12  # samples of a part, to say where it is
_SAMPLES = 2**16
_SMALL = 0.25  # of the skin's area: the largest eye, lip or mouth
_DETAILS = {"nose": re.compile("nose"), "brow": re.compile("brow|^[lr]b$"), "hair": re.compile("hair$")}
_SIDED = (("left_eye", "right_eye"), ("upper_lip", "lower_lip"))
_Parts = Mapping[str, Bool[np.ndarray, "h w"]]


def guess_order(maps: Sequence[UInt8[np.ndarray, "H W"]]) -> list[LabelTable]:
    """Return the tables that explain label maps of indices, the likeliest first; those after it fit nearly as well.

    Args:
        maps: as stored, of one upright head, some of them frontal; the `_FRONTAL` that fit best count.
    """
    fits = {table.name: [_fit(labels, table) for labels in maps] for table in TABLES}
    means = {name: float(np.mean(sorted(fit)[-_FRONTAL:])) for name, fit in fits.items() if fit and min(fit) >= 0}
    best = max(means.values(), default=0.0)
    likely = [table for table in TABLES if means.get(table.name, 0.0) >= max(_MIN_FIT, best - _NEAR)]
    return sorted(likely, key=lambda table: -means[table.name])


def _fit(labels: UInt8[np.ndarray, "H W"], table: LabelTable) -> float:
    """The share of a face's relations that hold with a table's names; -1: an index has no name."""
    step = max(1, int(np.sqrt(labels.size / _SAMPLES)))
    small = labels[::step, ::step]
    if int(small.max(initial=0)) >= len(table.names):
        return -1.0
    parts = _parts(small, table)
    skin = parts.get("skin")
    if skin is None:
        return 0.0
    relations = [_around(small, table)] * 3  # counts for several
    face = [name for pair in _SIDED for name in pair if name in table.classes] + ["mouth_interior"]
    relations += [name in parts for name in (*face[:-1], "nose") if name in (*table.classes, *_named(table))]
    relations += [bool(parts[name].sum() < _SMALL * skin.sum()) for name in face if name in parts]
    relations += [_within(parts[name], skin) for name in (*face, "nose", "brow") if name in parts]
    rows = {name: float(np.nonzero(pixels)[0].mean()) for name, pixels in parts.items()}
    eyes, lips = ([name for name in pair if name in rows] for pair in _SIDED)
    order = [(eye, lip) for eye in eyes for lip in lips]
    order += [("brow", eye) for eye in eyes] + [(eye, "nose") for eye in eyes] + [("nose", lip) for lip in lips]
    order += [("upper_lip", "lower_lip"), ("skin", "neck_other"), ("hair", "neck_other"), ("hair", "lower_lip")]
    order += [("lower_lip", "other"), ("upper_lip", "neck_other")]
    relations += [rows[above] < rows[below] for above, below in order if above in rows and below in rows]
    return float(np.mean(relations))


def _parts(small: UInt8[np.ndarray, "h w"], table: LabelTable) -> _Parts:
    """Where each class lies, the nose, the brows and the hair, and what is none of a face's parts: clothes, limbs."""
    kinds = [{known} for known in table.classes]
    for name, kind in zip(table.names, kinds, strict=True):
        kind.update(detail for detail, pattern in _DETAILS.items() if pattern.search(name.casefold()))
    ours = {BACKGROUND, UNLABELLED, "skin", "ears", "mouth_interior", "neck_other", "hair", *_SIDED[0], *_SIDED[1]}
    kinds = [kind if kind & ours else {"other"} for kind in kinds]
    found = {name: np.isin(small, [k for k, kind in enumerate(kinds) if name in kind]) for name in set().union(*kinds)}
    return {name: pixels for name, pixels in found.items() if pixels.sum() >= _FEW}


def _named(table: LabelTable) -> list[str]:
    return [detail for detail, pattern in _DETAILS.items() if any(map(pattern.search, table.names))]


def _around(small: UInt8[np.ndarray, "h w"], table: LabelTable) -> bool:
    """Whether most of the border, but the lower one, is background."""
    border = np.concatenate([small[0], small[:, 0], small[:, -1]])
    backdrop = [k for k, name in enumerate(table.classes) if name in (BACKGROUND, UNLABELLED)]
    return bool(np.isin(border, backdrop).mean() > 0.5)


def _within(part: Bool[np.ndarray, "h w"], skin: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a part's rows and columns are among the skin's."""
    return all(
        np.flatnonzero(skin.any(axis))[0] <= np.flatnonzero(part.any(axis)).mean() <= np.flatnonzero(skin.any(axis))[-1]
        for axis in (0, 1)
    )
