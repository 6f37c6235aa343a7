"""A sampler on disk: a folder with `sampler.json`, which describes it, and `sampler.safetensors`, which holds it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coregister.sampler.categories import MAX_CATEGORIES, Factor, condition_size
from coregister.sampler.decoder import PARTS, Decoder, Part, Sampler
from coregister.sampler.metrics import NetworkMetrics
from coregister.sampler.networks import Architecture, ConditionalVAE
from coregister.sampler.training import TrainedNetwork, TrainingSettings
from registration.errors import InputError
from registration.storage.hashing import hash_arrays, versions
from registration.storage.records import Record
from registration.storage.safetensors_files import read_tensors, write_tensors

RECORD, TENSORS = "sampler.json", "sampler.safetensors"
_MAX_SIZE = 65536  # of a layer
_MAX_LAYERS = 16
_FIX = "give the folder that `gnmreg sampler train` wrote, or train again"


@dataclass(frozen=True, kw_only=True)
class PartRecord:
    """One trained network."""

    coefficients: int
    layers: tuple[int, ...]  # of the encoder
    latent: int
    factors: tuple[Factor, ...]
    scale: float
    settings: TrainingSettings
    training_samples: int
    held_out_samples: int
    subjects: int
    counts: Mapping[str, Mapping[str, int]]  # factor -> category -> samples
    metrics: NetworkMetrics


@dataclass(frozen=True, kw_only=True)
class SamplerRecord(Record, kind="gnm-sampler", title="sampler", fix=_FIX):
    """`sampler.json`."""

    parts: Mapping[str, PartRecord]
    content_id: str  # sha256 of the arrays
    model: str = ""  # content hash of the head model that the coefficients belong to
    depth_mm: Mapping[str, float] = field(default_factory=dict)  # as `Sampler.depth_mm`
    inputs: Mapping[str, str] = field(default_factory=dict)  # what the coefficients were read from -> digest
    remarks: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)  # part -> duration of its training; of the audit
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)  # of all cores together
    threads: int = 0  # of the training; other numbers may give slightly other networks
    versions: Mapping[str, str] = field(default_factory=versions)


def arrays_of(networks: Mapping[Part, TrainedNetwork]) -> dict[str, np.ndarray]:
    """Return all arrays of networks by name: those of PyTorch, the offset, and the latent moments."""
    arrays = dict[str, np.ndarray]()
    for part, trained in networks.items():
        state = {f"{part}.{name}": tensor.numpy() for name, tensor in trained.network.state_dict().items()}
        own = {"offset": trained.offset, "latent_mean": trained.latent_mean, "latent_spread": trained.latent_spread}
        arrays |= state | {f"{part}.{name}": np.asarray(array, np.float32) for name, array in own.items()}
    return arrays


def content_id(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the digest of arrays, in the order of their names."""
    return hash_arrays(*(arrays[name] for name in sorted(arrays)))


def write_sampler(record: SamplerRecord, arrays: dict[str, np.ndarray], folder: Path) -> None:
    """Write both files into an existing folder; the record last."""
    write_tensors(folder / TENSORS, arrays)
    record.write(folder / RECORD)


def read_sampler(folder: Path) -> tuple[Sampler, SamplerRecord]:
    """Read a sampler.

    Args:
        folder: that holds both files.

    Raises:
        InputError: a file is missing, malformed or of another sampler; sizes are out of range; arrays are missing, of
            another shape than the record says, or not finite.
    """
    record = SamplerRecord.read(folder / RECORD)
    file = folder / TENSORS
    refuse = partial(InputError.unreadable, SamplerRecord.TITLE, where=file, fix=_FIX)
    for part in record.parts.values():
        _check_sizes(part, folder / RECORD)
    if not record.parts or set(record.parts) - set(PARTS):
        expected, got = "identity, expression or both", ", ".join(record.parts) or "no part"
        raise SamplerRecord.invalid(folder / RECORD, expected=expected, got=got)
    arrays = read_tensors(file, refuse)
    networks = {name: _network(name, part, arrays, refuse) for name, part in record.parts.items()}
    if (found := content_id(arrays)) != record.content_id:
        raise refuse(expected=f"arrays of content id {record.content_id}", got=found)
    decoders: dict[Any, Decoder] = {
        name: trained.decoder(record.parts[name].factors) for name, trained in networks.items()
    }
    sampler = Sampler(decoders=decoders, model=record.model, depth_mm=record.depth_mm, origin=str(folder))
    return sampler, record


def _check_sizes(part: PartRecord, where: Path) -> None:
    """Refuse sizes for which no network should be allocated. Raises InputError."""
    sizes = {"coefficients": part.coefficients, "latent": part.latent}
    sizes |= {f"layers[{k}]": size for k, size in enumerate(part.layers)}
    for name, size in sizes.items():
        if not 1 <= size <= _MAX_SIZE:
            raise SamplerRecord.invalid(where, expected=f"{name} from 1 to {_MAX_SIZE}", got=size)
    if not 1 <= len(part.layers) <= _MAX_LAYERS:
        raise SamplerRecord.invalid(where, expected=f"1 to {_MAX_LAYERS} layers", got=len(part.layers))
    names = [factor.name for factor in part.factors]
    categories = [factor.categories for factor in part.factors]
    if not names or len(set(names)) < len(names) or any(len(set(c)) < len(c) or not c for c in categories):
        raise SamplerRecord.invalid(where, expected="factors with categories, each name once", got=names)
    if condition_size(part.factors) > MAX_CATEGORIES:
        raise SamplerRecord.invalid(where, expected=f"at most {MAX_CATEGORIES} categories", got="more")


def _network(name: str, part: PartRecord, arrays: dict[str, np.ndarray], refuse: Any) -> TrainedNetwork:
    """The network of one part; its arrays must be exactly those that the record describes."""
    conditions = condition_size(part.factors)
    with torch.device("meta"):  # shapes without memory
        network = ConditionalVAE(
            Architecture(coefficients=part.coefficients, conditions=conditions, layers=part.layers, latent=part.latent)
        )
    expected = {key: tuple(tensor.shape) for key, tensor in network.state_dict().items()}
    others = {
        "offset": (part.coefficients,),
        "latent_mean": (conditions, part.latent),
        "latent_spread": (part.latent, part.latent),
    }
    own = {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}
    for key, shape in {**expected, **others}.items():
        if key not in own or own[key].shape != shape or own[key].dtype != np.float32:
            found = f"{own[key].dtype} {own[key].shape}" if key in own else "no such array"
            raise refuse(expected=f"{name}.{key}: float32 {shape}", got=found)
    tensors = {key: torch.from_numpy(own[key].copy()) for key in expected}
    network.load_state_dict(tensors, assign=True)
    return TrainedNetwork(
        network=network.eval().requires_grad_(False),
        offset=own["offset"],
        scale=part.scale,
        latent_mean=own["latent_mean"],
        latent_spread=own["latent_spread"],
    )
