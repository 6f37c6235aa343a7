"""`gnmreg model map`: a map between the topologies of two heads."""

from pathlib import Path

from registration.progress import Progress
from registration.storage.files import check_output_file
from registration.topology_map import file, landmarked, picture
from registration.topology_map.make import map_topologies
from registration.topology_map.topology_map import TopologyMap


def make_topology_map(source: Path, target: Path, out: Path, drawing: Path | None, progress: Progress) -> TopologyMap:
    """Make the map from a head's topology to another's, and write it with its picture.

    A refused map is written too: its status says so.

    Args:
        source: a head model, or a mesh in metres with landmark schemes beside it.
        target: likewise; the mesh may have any unit and frame.
        out: the file to write.
        drawing: PNG file of the picture; None: drawn beside the map if it is refused.
        progress: receives the steps.

    Raises:
        InputError: before anything is computed: a file cannot be read, or the landmarks do not suffice.
    """
    for path in (out, drawing):
        if path is not None:
            check_output_file(path)
    a, b = landmarked.read(source), landmarked.read(target)
    mapped = map_topologies(a, b, progress=progress)
    if drawing is None and not mapped.accepted:
        drawing = out.with_suffix(".png")
    if drawing is not None:
        picture.draw(mapped, a, b, drawing)
    file.write(mapped, out)
    return mapped


def lines(mapped: TopologyMap) -> list[str]:
    """Return what was measured and decided, for people."""
    figures = mapped.figures
    return [
        f"{mapped.mask.sum()} of {len(mapped.mask)} vertices mapped, {figures['covered']:.0%} of the outer surface",
        f"distance {figures['mean_mm']:.4f} mm mean, {figures['max_mm']:.3f} largest",
        f"there and back {figures['cycle_mean_mm']:.3f} mm mean, {figures['cycle_max_mm']:.3f} largest",
        f"{figures['flipped_faces']:.0f} faces flipped",
        mapped.status,
        *mapped.reasons,
    ]
