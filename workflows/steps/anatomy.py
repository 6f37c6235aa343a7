"""`gnmreg model anatomy` and `gnmreg model place`: eyes, teeth, tongue and pupils of a model made or placed anew."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coregister.anatomy import placement
from coregister.anatomy.assemble import AnatomySettings, manifest, regenerate
from coregister.anatomy.tongue import TongueSources
from coregister.anatomy.tongue_keypoints import read_recording
from coregister.next_model import provenance
from registration.errors import InputError
from registration.geometry.rigid import align
from registration.model import export, gnm_npz
from registration.model.gnm_npz import GNMData, topology_hash
from registration.progress import Progress
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage.files import atomic_file
from registration.storage.hashing import hash_file
from workflows.records.held_out import read_held_out


@dataclass(frozen=True, kw_only=True)
class TongueFiles:
    """Data of real tongues: recordings of key points, and a run or NPZ file of registrations."""

    keypoints: tuple[Path, ...] = ()
    registrations: Path | None = None

    def read(self, model: GNMData) -> tuple[TongueSources, dict[str, str]]:
        """Return the data, and digests of the files. Raises InputError for what cannot be read or has no expression."""
        recordings = [read_recording(file) for file in self.keypoints]
        digests = {f"keypoints {k}": hash_file(file) for k, file in enumerate(self.keypoints)}
        if self.registrations is None:
            return TongueSources(recordings=recordings), digests
        held = read_held_out(self.registrations)
        if topology_hash(held.triangles) != topology_hash(model.triangles):
            raise InputError(
                "The registrations of tongues have another topology than the model",
                where=self.registrations,
                expected=f"{len(model.template_vertex_positions)} vertices, with the model's triangles",
                got=f"{len(held.subjects[0].neutral)} vertices",
                fix="give registrations that were made with this model or one of its line",
            )
        weights = SkullSkin.from_model(model).area
        expressions = []
        for subject in held.subjects:
            neutral = subject.neutral.astype(np.float64)
            turn = align(neutral[None], model.template_vertex_positions.astype(np.float64), weights[None])[0, :3, :3]
            expressions += [(moved.astype(np.float64) - neutral) @ turn.T for moved in subject.expressions]
        if not expressions:
            raise InputError(
                "The registrations of tongues have no expressions",
                where=self.registrations,
                expected="subjects with stabilized expressions",
                got=f"{len(held.subjects)} neutrals",
                fix="stabilize the run first (gnmreg stabilize)",
            )
        return TongueSources(expressions=expressions, recordings=recordings), {**digests, **held.inputs}


def write_anatomy(
    model: Path, out: Path, settings: AnatomySettings, progress: Progress, tongues: TongueFiles | None = None
) -> list[str]:
    """Regenerate parts of a model and write it with its manifest, landmark schemes and expression statistics.

    Args:
        model: a GNM NPZ file.
        out: the file to write, NAME.npz, with NAME.manifest.json beside it.
        settings: parts and seed.
        progress: receives the steps.
        tongues: files of real tongues; None: none.

    Returns:
        What was made: a sentence for each part, and one for the layout.

    Raises:
        InputError: before anything is written: the model cannot be read or lacks a part's structure, the settings are
            invalid, or `out` is the model itself or no NPZ file that can be written.
    """
    settings.check()
    check_new_model(model, out)
    data = gnm_npz.read(model)
    sources, digests = (tongues or TongueFiles()).read(data)
    progress.message(f"regenerating {', '.join(settings.parts)}")
    made = regenerate(data, settings, sources)
    _copy_statistics(model, out)
    provenance.write(made.data, manifest(made, data, settings, digests), None, out, model)
    lines = []
    for part, record in made.anatomy["parts"].items():
        kept = f"{record['variance_kept']:.2%} of the variance"
        lines.append(f"{part}: {record['components']} components of {record['samples']} samples, {kept}")
    layout = ", ".join(f"{name} {count}" for name, count in made.anatomy["layout"].items())
    return [*lines, f"components: {layout}"]


def write_placed(model: Path, out: Path) -> list[str]:
    """Place teeth and tongue in a model's bases and write it with its manifest, as `write_anatomy`.

    Args:
        model: a GNM NPZ file.
        out: the file to write, NAME.npz, with NAME.manifest.json beside it.

    Returns:
        What was done, in sentences.

    Raises:
        InputError: as `write_anatomy`.
    """
    check_new_model(model, out)
    data = gnm_npz.read(model)
    placed = placement.place(data)
    _copy_statistics(model, out)
    provenance.write(placed.data, placement.manifest(placed, data), None, out, model)
    counts, components, moved = (placed.record[name] for name in ("vertices", "components", "moved_mm"))
    parts = {"identity": "teeth and tongue", "expression": "lower teeth and tongue"}
    lines = [
        f"{basis}: {counts[basis]} vertices of {part} in {components[basis]} components, "
        f"{moved[basis]:.3f} mm from before"
        for basis, part in parts.items()
    ]
    return [*lines, f"lower lip and chin: {placed.record['not_rigid_mm']:.3f} mm of their motion are not rigid"]


def check_new_model(model: Path, out: Path) -> None:
    """Refuse a file name for a new model: no NPZ file, not writable, or the previous model. Raises InputError."""
    if out.suffix.lower() != ".npz":
        raise InputError("The new model has no NPZ file's name", where=out, expected="NAME.npz", got=out.name)
    export.check_new_model(model, out)


def _copy_statistics(model: Path, out: Path) -> None:
    """Keep the statistics of the skin's components, which do not change."""
    coefficients = model.with_name(f"{model.stem}.expressions.npz")
    if coefficients.is_file():
        out.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(out.with_name(f"{out.stem}.expressions.npz")) as temporary:
            shutil.copyfile(coefficients, temporary)
