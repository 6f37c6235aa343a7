"""The cranium under short hair, of heads whose true face is known: from the auxiliary model and from other fills.

Only the first model has people of its own. `python -m bench.cranium` measures registrations.
"""

from collections.abc import Iterator

import numpy as np

from bench.anatomy_checks import Figure
from bench.support.cranium_measures import MODEL, CraniumMeasure, fills
from coregister.anatomy.cranium_model import build_cranium_model, under_hair
from coregister.first_model import build
from coregister.synthetic.neutral_heads import neutral_heads
from registration.cranium.complete import CraniumCompletion
from registration.frames import MM_PER_M
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData

_HEADS, _HELD_OUT = 200, 20
_SEED, _OTHER_SEED = 0, 1


def figures(data: GNMData) -> Iterator[Figure]:
    """Hide the craniums of people who made no part of the auxiliary model, and fill them."""
    first = gnm_npz.read(build.bootstrap())
    if gnm_npz.topology_hash(first.triangles) != gnm_npz.topology_hash(data.triangles):
        return
    model = build_cranium_model(data, neutral_heads(_HEADS, _SEED), seed=_SEED, source="MakeHuman's population")
    yield Figure(name="rank by leave-one-out", value=model.rank, unit="")
    yield Figure(name="noise by leave-one-out", value=MM_PER_M * model.noise, unit="mm")
    heads = neutral_heads(_HELD_OUT, _OTHER_SEED).astype(np.float64)
    hair = under_hair(data)
    confidence, complete = np.where(hair, 0.0, 0.9), CraniumCompletion(data, model)
    completed = [complete(head, confidence) for head in heads]
    first_completed = completed[0]
    assert first_completed is not None
    measure = CraniumMeasure.of(data, first_completed)
    errors = {
        name: [measure(fill(head, confidence), head) for head in heads] for name, fill in fills(data, model).items()
    }
    means = {name: float(np.mean([error.cranium_mm for error in of_fill])) for name, of_fill in errors.items()}
    for name, mean in means.items():
        yield Figure(name=f"cranium, {name}, mean", value=mean, unit="mm", most=3.5 if name == MODEL else None)
    for name, mean in means.items():
        if name != MODEL:
            yield Figure(name=f"better than {name}", value=100 * (1 - means[MODEL] / mean), unit="%", least=25)
    moved = [
        np.linalg.norm(c.vertices - head, axis=1)[~c.hidden].max()
        for c, head in zip(completed, heads, strict=True)
        if c
    ]
    yield Figure(name="observed skin moved at most", value=MM_PER_M * max(moved), unit="mm", most=0.02)
    ratio = np.mean([error.curvature / error.true_curvature for error in errors[MODEL]])
    yield Figure(name="curvature in the band, of the truth's, p95", value=float(ratio), unit="", most=1.05)
    calibration = [
        np.linalg.norm(c.vertices - head, axis=1)[hair] / c.deviation[hair]
        for c, head in zip(completed, heads, strict=True)
        if c
    ]
    yield Figure(
        name="error over posterior deviation, rms", value=float(np.sqrt(np.mean(np.square(calibration)))), unit=""
    )
