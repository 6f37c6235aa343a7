"""What was found of eyes, teeth and tongue in a model, for the picture of `gnmreg model info`."""

from collections.abc import Callable, Sequence

import numpy as np

from registration.anatomy.eye_structure import find_eyes
from registration.anatomy.tongue_structure import find_tongue
from registration.anatomy.tooth_structure import find_teeth, tooth_labels
from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.model.gnm_npz import GNMData
from registration.model.info import Panel, rotation_y

_AXIS_END = 2.2  # of the drawn optical axes, in radii of the sclera
_COLOURS = {"iris": (0.25, 0.45, 0.75), "pupil": (0.03, 0.03, 0.03), "sclera": (0.9, 0.9, 0.88)}
_GUM, _TONGUE = (0.80, 0.42, 0.42), (0.85, 0.45, 0.45)
_TEETH = ((0.95, 0.9, 0.6), (0.6, 0.8, 0.95))  # neighbours differ
_OBLIQUE = np.array([[1.0, 0, 0], [0, 0.77, -0.64], [0, 0.64, 0.77]])  # seen from 40 degrees above
_FROM_BELOW = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_FROM_ABOVE = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def anatomy_panels(data: GNMData) -> tuple[Sequence[Panel], Sequence[str]]:
    """Return a panel of each part whose structure is found, and a line about each part."""
    panels, notes = list[Panel](), list[str]()
    finders: tuple[tuple[str, Callable[[GNMData], tuple[list[Panel], str]]], ...] = (
        ("eyes", _eyes),
        ("teeth", _teeth),
        ("tongue", _tongue),
    )
    for name, find in finders:
        try:
            found, note = find(data)
            panels += found
        except InputError as error:
            note = f"not found: {error.line}"
        notes.append(f"{name}: {note}")
    return panels, notes


def _eyes(data: GNMData) -> tuple[list[Panel], str]:
    """The inner shells and the optical axes, obliquely from above."""
    eyes = find_eyes(data)
    shown, colours = _nothing(data)
    lines = []
    for eye in (eyes.left, eyes.right):
        shown[eye.vertices[~eyes.exterior]] = True
        colours[eye.vertices] = _COLOURS["sclera"]
        colours[eye.vertices[eyes.iris]] = _COLOURS["iris"]
        colours[eye.vertices[eyes.pupil]] = _COLOURS["pupil"]
        lines.append(eye.centre + np.array([[0.0], [_AXIS_END * eyes.sclera_radius]]) * eye.axis)
    rotation = _OBLIQUE @ rotation_y(-20)
    panel = Panel(title="optical axes", vertices=shown, colours=colours, lines=lines, rotation=rotation)
    deviation = MM_PER_M * max(eyes.left.deviation, eyes.right.deviation)
    note = (
        f"sclera {MM_PER_M * eyes.sclera_radius:.2f} mm, {deviation:.3f} mm from surfaces of revolution, "
        f"left {MM_PER_M * eyes.asymmetry:.3f} mm from right"
    )
    return [panel], note


def _teeth(data: GNMData) -> tuple[list[Panel], str]:
    """The biting edges of both arches, each tooth with its FDI number."""
    panels, arches = [], find_teeth(data)
    for arch, rotation in zip(arches, (_FROM_BELOW, _FROM_ABOVE), strict=True):
        shown, colours = _nothing(data)
        shown[arch.vertices] = True
        colours[arch.gum] = _GUM
        for k, tooth in enumerate(arch.teeth):
            colours[tooth.vertices] = _TEETH[k % 2]
        names = {str(fdi): position for fdi, position in tooth_labels((arch,)).items()}
        title = f"{arch.name} teeth, FDI numbers"
        panels.append(Panel(title=title, vertices=shown, colours=colours, names=names, rotation=rotation))
    return panels, " and ".join(f"{len(arch.teeth)} {arch.name}" for arch in arches)


def _tongue(data: GNMData) -> tuple[list[Panel], str]:
    """The tongue from the side, with its centre line and the tip."""
    tongue = find_tongue(data)
    shown, colours = _nothing(data)
    shown[tongue.vertices], colours[tongue.vertices] = True, _TONGUE
    panel = Panel(
        title="tongue: centre line and tip",
        vertices=shown,
        colours=colours,
        lines=[tongue.centre],
        names={"tip": tongue.rest[tongue.tip] + 0.05 * tongue.length * tongue.axis},
        rotation=rotation_y(-75.0),
    )
    return [panel], f"{MM_PER_M * tongue.length:.1f} mm long, {2 * MM_PER_M * tongue.half_width:.1f} mm wide"


def _nothing(data: GNMData) -> tuple[np.ndarray, np.ndarray]:
    count = len(data.template_vertex_positions)
    return np.zeros(count, bool), np.zeros((count, 3))
