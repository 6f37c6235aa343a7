"""The input of `gnmreg model compare`: registered scans, of a run of `gnmreg subject` or in one NPZ file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from coregister.evaluate.face_data import FaceSample
from registration.capture.native import natural_key, read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.storage.files import atomic_file
from registration.storage.npz import NpzSchema
from registration.storage.registration_folder import load_registration
from workflows.records.dataset import CATEGORY
from workflows.records.held_out import CATEGORIES, TAG
from workflows.records.subject import is_subject_folder, read_subject

SCHEMA = NpzSchema(
    title="file of registered scans",
    fix="see docs/formats.md, Registered scans",
    fields={
        "vertices": ("float", "N V 3"),
        "triangles": ("integer", "F 3"),
        "subjects": ("text", "N"),
        "labels": ("text", "N"),
        "scan": ("float", "S 3"),
        "scan_triangles": ("integer", "G 3"),
        "scan_counts": ("integer", "N 2"),
    },
    families={TAG: ("text", "N")},
    indices={"triangles": "V"},
)


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceSampleSet:
    """Registered scans and their topology."""

    samples: tuple[FaceSample, ...]
    triangles: Int[np.ndarray, "F 3"]


def read_samples(source: Path, captures: Path | None = None) -> FaceSampleSet:
    """Read registered scans.

    Args:
        source: an NPZ file, or a run of `gnmreg subject`.
        captures: of a run, the folder of its subjects with their captures, which hold scans and tags.

    Raises:
        InputError: there is no registered scan, a file or record cannot be read, or topologies differ.
    """
    found = _from_run(Path(source), captures) if Path(source).is_dir() else _from_file(Path(source))
    if not found.samples:
        expected = "usable registrations of captures with a scan" if captures else "--captures with the run's scans"
        raise _error("There are no registered scans", source, expected, "none")
    return found


def write_samples(samples: tuple[FaceSample, ...], triangles: Int[np.ndarray, "F 3"], file: Path) -> None:
    """Write registered scans as one NPZ file; a scan that is the registered mesh itself takes no space."""
    own = [s.scan is s.vertices for s in samples]
    tags = sorted({tag for sample in samples for tag in sample.tags})
    counts = [(0, 0) if o else (len(s.scan), len(s.scan_triangles)) for o, s in zip(own, samples, strict=True)]
    scans = [np.zeros((0, 3)), *(s.scan for o, s in zip(own, samples, strict=True) if not o)]
    faces = [np.zeros((0, 3), np.int64), *(s.scan_triangles for o, s in zip(own, samples, strict=True) if not o)]
    arrays: dict[str, Any] = {
        "vertices": np.stack([s.vertices for s in samples]).astype(np.float32),
        "triangles": triangles,
        "subjects": np.array([s.subject for s in samples]),
        "labels": np.array([s.name for s in samples]),
        CATEGORIES: np.array([s.category for s in samples]),
        "scan": np.concatenate(scans).astype(np.float32),
        "scan_triangles": np.concatenate(faces),
        "scan_counts": np.array(counts, np.int64).reshape(-1, 2),
        **{TAG + tag: np.array([str(s.tags.get(tag, "")) for s in samples]) for tag in tags},
    }
    with atomic_file(Path(file)) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _from_file(file: Path) -> FaceSampleSet:
    arrays = SCHEMA.read(file)
    counts = arrays["scan_counts"].astype(np.int64)
    ends = np.cumsum(counts, 0)
    total = np.array([len(arrays["scan"]), len(arrays["scan_triangles"])])
    if (counts < 0).any() or not np.array_equal(counts.sum(0), total):
        raise _error("The scans are incomplete", f"{file}, scan_counts", f"sums {total}", f"{counts.sum(0)}")
    categories = arrays.get(CATEGORIES, arrays["labels"])
    if categories.shape != arrays["labels"].shape or len(set(arrays["labels"].tolist())) < len(counts):
        raise _error("The samples are named wrongly", file, "unique labels, a category each", "others")
    samples = []
    for row, (points, faces) in enumerate(counts):
        vertices = arrays["vertices"][row].astype(np.float64)
        scan, triangles = vertices, arrays["triangles"]
        if points:
            scan = arrays["scan"][ends[row, 0] - points : ends[row, 0]].astype(np.float64)
            triangles = arrays["scan_triangles"][ends[row, 1] - faces : ends[row, 1]]
            if faces and not (triangles.min() >= 0 and triangles.max() < points):
                got = f"{triangles.min()} to {triangles.max()}"
                raise _error("A scan's triangles are wrong", f"{file}, sample {row}", f"0 to {points - 1}", got)
        tags = {n.removeprefix(TAG): _value(str(v[row])) for n, v in arrays.items() if n.startswith(TAG)}
        samples.append(
            FaceSample(
                name=str(arrays["labels"][row]),
                subject=str(arrays["subjects"][row]),
                category=str(categories[row]),
                vertices=vertices,
                scan=scan,
                scan_triangles=triangles.astype(np.int64),
                tags={name: value for name, value in tags.items() if value != ""},
            )
        )
    return FaceSampleSet(samples=tuple(samples), triangles=arrays["triangles"].astype(np.int64))


def _value(text: str) -> str | int:
    """A tag's value: whole numbers, such as an age, are grouped by tens."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else text


def _from_run(run: Path, captures: Path | None) -> FaceSampleSet:
    folders = sorted(filter(is_subject_folder, run.iterdir()), key=lambda folder: natural_key(folder.name))
    samples, topologies = [], []
    for folder in folders if captures is not None else []:
        record = read_subject(folder)
        assert record is not None and captures is not None, "it is a subject folder"
        for row in (row for row in record.rows if row.usable):
            capture = read_capture(Path(captures) / folder.name / row.name)
            if capture.scan is None:
                continue
            registration, scan = load_registration(folder / row.name), read_scan(capture.scan)
            tags: Mapping[str, Any] = {k: v for k, v in capture.tags.items() if k != CATEGORY}
            origin = registration.vertices.mean(0).astype(np.float64)
            samples.append(
                FaceSample(
                    name=f"{folder.name}_{row.name}",
                    subject=record.subject,
                    category=str(capture.tags.get(CATEGORY, capture.expression)),
                    vertices=registration.vertices.astype(np.float64) - origin,
                    scan=scan.vertices.astype(np.float64) - origin,
                    scan_triangles=scan.triangles,
                    tags=tags,
                )
            )
            topologies.append(registration.triangles)
    if any(not np.array_equal(topology, topologies[0]) for topology in topologies):
        raise _error("The registrations have different topologies", run, "one topology", "several")
    triangles = topologies[0] if topologies else np.zeros((0, 3), np.int64)
    return FaceSampleSet(samples=tuple(samples), triangles=triangles)


def _error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=SCHEMA.fix)
