"""Small sets of coefficients whose distribution is known."""

from pathlib import Path

import numpy as np

from coregister.sampler import storage
from coregister.sampler.metrics import measure
from coregister.sampler.samples import CoefficientSet, coefficient_set, split_by_subject
from coregister.sampler.storage import PartRecord, SamplerRecord
from coregister.sampler.training import TrainingSettings, train


def factor_set(count: int = 600, classes: int = 4, factors: int = 3, size: int = 12, seed: int = 0) -> CoefficientSet:
    """Samples of classes with different means, which vary along `factors` directions, equally in all classes."""
    rng = np.random.default_rng(seed)
    means, directions = 2 * rng.normal(size=(classes, size)), rng.normal(size=(factors, size))
    number = np.arange(count) % classes
    values = means[number] + rng.normal(size=(count, factors)) @ directions + 0.02 * rng.normal(size=(count, size))
    names = [(f"act{k}",) for k in number]
    return coefficient_set(values, names, ("expression",), [f"p{k:04d}" for k in range(count)], "made")


def write_sampler(folder: Path) -> Path:
    """Write a sampler of expressions that was trained for one step."""
    samples, held_out = split_by_subject(factor_set(60), 0)
    settings = TrainingSettings(steps=1)
    trained = train(samples, held_out, (8,), settings)
    part = PartRecord(
        coefficients=12,
        layers=(8,),
        latent=64,
        factors=samples.factors,
        scale=trained.scale,
        settings=settings,
        training_samples=len(samples.subjects),
        held_out_samples=len(held_out.subjects),
        subjects=len(samples.subjects),
        counts={"expression": samples.counts(0)},
        metrics=measure(trained, samples, held_out, 0),
    )
    arrays = storage.arrays_of({"expression": trained})
    folder.mkdir(parents=True)
    storage.write_sampler(
        SamplerRecord(parts={"expression": part}, content_id=storage.content_id(arrays)), arrays, folder
    )
    return folder
