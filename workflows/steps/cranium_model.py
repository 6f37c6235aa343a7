"""`gnmreg model cranium`: the auxiliary model that completes craniums, from whole heads."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from coregister.anatomy.carried_heads import carry_heads
from coregister.anatomy.cranium_model import MIN_HEADS, build_cranium_model
from coregister.anatomy.head_meshes import read_heads
from registration.cranium.auxiliary_model import CraniumModel, beside, write
from registration.errors import InputError, check_seed
from registration.frames import MM_PER_M
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import schemes_beside
from registration.progress import NullProgress, Progress
from registration.storage.files import check_output_file
from registration.topology_map.landmarked import of_model


def make_cranium_model(
    model: Path,
    out: Path | None = None,
    *,
    heads: Path | None = None,
    count: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Path, CraniumModel]:
    """Build the auxiliary model of a head model's topology and write it.

    Args:
        model: the head model.
        out: the file to write; None: beside the model, where registrations find it.
        heads: folder of whole heads in the model's topology; None: people of MakeHuman's population, carried
            to the model's topology by a map from the first model's.
        count: of the people.
        seed: of the people.
        progress: where to report to.

    Returns:
        The file and what it holds.

    Raises:
        InputError: the model is no GNM file, a head cannot be used, there are fewer than 30, or the map
            from the first model's topology is refused and there is no folder of heads.
    """
    progress = progress or NullProgress()
    check_seed(seed, "--seed")
    data, out = gnm_npz.read(Path(model)), beside(model) if out is None else Path(out)
    check_output_file(out)
    if heads is not None:
        progress.message("reading the heads")
        built = build_cranium_model(data, read_heads(heads, data), seed=-1, source=f"meshes in {Path(heads).name}")
    else:
        if count < MIN_HEADS:
            what = "There are too few heads for an auxiliary model of the cranium"
            expected = f"at least {MIN_HEADS} heads"
            raise InputError(what, where="--count", expected=expected, got=count, fix="sample more people")
        people = _population(Path(model), data, count, seed, progress)
        progress.message("choosing rank and noise by leave-one-out")
        built = build_cranium_model(data, people, seed=seed, source="MakeHuman's population (CC0)")
    write(built, out)
    return out, built


def lines(model: CraniumModel) -> list[str]:
    """Return what was built, for people."""
    best = float(model.tried_errors.min()) * MM_PER_M
    return [
        f"{model.heads} heads: {model.source}",
        f"rank {model.rank}, noise {model.noise * MM_PER_M:g} mm (best of {len(model.tried_ranks)} by leave-one-out)",
        f"a left-out head's cranium under short hair is predicted to {best:.2f} mm rms",
    ]


def _population(model: Path, data: GNMData, count: int, seed: int, progress: Progress) -> Float[np.ndarray, "N V 3"]:
    from coregister.first_model.build import bootstrap
    from coregister.synthetic.neutral_heads import neutral_heads

    progress.message("sampling people")
    path = bootstrap()
    first, people = gnm_npz.read(path), neutral_heads(count, seed)
    if gnm_npz.topology_hash(first.triangles) == gnm_npz.topology_hash(data.triangles):
        return people
    progress.message("carrying them to the model's topology")
    source, target = (
        of_model(mesh, schemes_beside(file, mesh.template_vertex_positions), file.name)
        for mesh, file in ((first, path), (data, model))
    )
    return carry_heads(people, source, target)
