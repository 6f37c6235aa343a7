"""How a model came about: its manifest, and the files beside the model file."""

import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coregister.next_model import eyelids
from coregister.next_model.alignment import Aligned, Rejected
from coregister.next_model.expression import Coefficients, Region
from coregister.next_model.identity import HeadIdentity
from coregister.next_model.training_data import Survey
from registration.frames import MM_PER_M
from registration.model import gnm_npz, landmarks
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage import hashing

KIND = "gnm-model"
SCHEMA = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Origin:
    """All that a manifest tells about. M expressions came in."""

    found: Survey
    aligned: Aligned
    head: HeadIdentity
    bases: Mapping[str, Region]  # of expressions; empty: the previous model's are kept
    expression_subjects: Sequence[str]  # M
    expression_labels: Sequence[str]  # M
    expression_weights: np.ndarray  # M; 0: left out
    rejected: Sequence[Rejected]
    filled: Mapping[str, int]  # neutrals and expressions of which some skin was not seen


def manifest(
    origin: Origin, previous: GNMData, data: GNMData, config: Any, categories: Mapping[str, str] | None
) -> dict[str, Any]:
    """JSON values; its entries are described in docs/formats.md."""
    found, head, aligned = origin.found, origin.head, origin.aligned
    inputs = {**found.digests, "previous": gnm_npz.content_hash(previous)}
    settings = hashing.to_jsonable(config)
    used = np.flatnonzero(origin.expression_weights > 0).tolist()
    labels = [origin.expression_labels[k] for k in used]
    counted = Counter(origin.expression_subjects[k] for k in used)
    names = [found.subjects[k] for k in aligned.kept]
    subjects = [
        {
            "subject": name,
            "tags": found.tags[k],
            "expressions": counted[name],
            "weight_of_each": 1 / counted[name] if counted[name] else 0.0,
            "residual_mm": residual,
        }
        for name, k, residual in zip(names, aligned.kept, aligned.residual_mm, strict=True)
    ]
    expressions = {name: _told(region, region.energy) for name, region in origin.bases.items()}
    told = {
        "kind": KIND,
        "schema": SCHEMA,
        "content_id": gnm_npz.content_hash(data),
        "input_hash": hashing.input_hash(inputs, settings),
        "inputs": inputs,
        "config": settings,
        "versions": hashing.versions(),
        "subjects": subjects,
        "rejected": [vars(one) for one in origin.rejected],
        "filled": origin.filled,
        "alignment": {"rounds": aligned.rounds},
        "identity": {
            **_told(head, head.variance),
            "samples": 2 * head.heads if head.mirrored else head.heads,
            "weight_of_each": 0.5 if head.mirrored else 1.0,
            "shares_tried_mm": {f"{share:.2f}": MM_PER_M * rms for share, rms in head.tried.items()},
            "carried": data.identity_names[len(head.basis) :],
        },
        "expression": expressions or "the previous model's: there are no expressions",
        "labels": dict(sorted(Counter(labels).items())),
        "categories": dict(sorted(Counter((categories or {}).get(label, label) for label in labels).items())),
        "demographics": _demographics([found.tags[k] for k in aligned.kept]),
        "figures": _figures(head, previous, data),
    }
    plain: dict[str, Any] = hashing.to_jsonable(told)
    return plain


def write(
    data: GNMData,
    manifest: Mapping[str, Any],
    coefficients: Coefficients | None,
    path: Path,
    previous: Path,
) -> None:
    """Writes the model file and, beside it, landmark schemes of the previous model, `NAME.manifest.json` and
    `NAME.expressions.npz` (`names`, `mean`, `covariance` of the regional coefficients). The model file comes last.

    Raises InputError for data that is no GNM model.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for scheme in landmarks.schemes_beside(previous, len(data.template_vertex_positions)).values():
        landmarks.write_scheme(scheme, path)
    if coefficients is not None:
        beside = path.with_name(f".{path.stem}.{os.getpid()}.npz")
        arrays = {"mean": coefficients.mean, "covariance": coefficients.covariance}
        np.savez(beside, allow_pickle=False, names=np.array(coefficients.names), **arrays)
        os.replace(beside, path.with_name(f"{path.stem}.expressions.npz"))
    beside = path.with_name(f".{path.stem}.{os.getpid()}.json")
    beside.write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(beside, path.with_name(f"{path.stem}.manifest.json"))
    gnm_npz.write(data, path)


def drift_mm(previous: GNMData, data: GNMData) -> float:
    """rms distance of the stable skin between two models' templates, as they lie."""
    stable = SkullSkin.of(previous).area
    away = data.template_vertex_positions.astype(np.float64) - previous.template_vertex_positions
    return float(MM_PER_M * np.sqrt((away**2).sum(1) @ stable / stable.sum()))


def _figures(head: HeadIdentity, previous: GNMData, data: GNMData) -> dict[str, Any]:
    template = data.template_vertex_positions.astype(np.float64)
    gap = eyelids.gap_change_mm(eyelids.sockets(data), template, data.vertex_identity_basis[: len(head.basis)])
    return {
        "drift_mm": drift_mm(previous, data),
        "lid_gap_change_mm": {"worst": gap.max(initial=0), "median": np.median(gap) if len(gap) else 0.0},
    }


def _told(part: HeadIdentity | Region, variance: np.ndarray) -> dict[str, Any]:
    return {
        "components": len(variance),
        "share_kept": part.share,
        "share_previous": part.previous,
        "method": part.method,
        "variance_mm2": MM_PER_M**2 * variance,
    }


def _demographics(tags: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Tag -> value -> subjects; ages by decade."""
    counts: dict[str, Counter[str]] = {}
    for of in tags:
        for name, value in of.items():
            decade = isinstance(value, (int, float)) and not isinstance(value, bool)
            told = f"{10 * int(value // 10)}-{10 * int(value // 10) + 9}" if decade else str(value)
            counts.setdefault(name, Counter())[told] += 1
    return {name: dict(sorted(count.items())) for name, count in sorted(counts.items())}
