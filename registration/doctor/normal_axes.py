"""Find normal maps in other axes, or in the world's frame, from where normals must point.

A surface that a camera sees faces it, and at the outline of the subject it points away from its inside. Both are linear
in the normals: for each of the 48 signed permutations of their axes the mean agreement is a trace of one matrix, summed
over the pixels once for normals as stored and once for normals in the world's frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from registration.capture.samples import ViewSample
from registration.doctor.contradictions import overlap
from registration.doctor.findings import FindingError, Fix, refuse
from registration.doctor.fixes import NormalFix, NormalFrameFix
from registration.types import Camera, NormalsFrame

_MARGIN = 0.15  # by which other axes must agree better, of 2: 1 for facing and 1 at the outline
_RIM = 2  # samples, width of the outline
_MIN_RIM, _MIN_PIXELS = 40, 200
_MIN_LENGTH = 0.5
_SAME = 0.85  # overlap of mask and normals that belong together
_LENGTHS = (0.75, 1.3)  # the median of unit normals with noise
_VARIATION = 0.02  # mean deviation of normals from their mean, below which all are equal
_NAMES: dict[tuple[int, ...], str] = {
    (1, 2, 3): "in the camera's frame",
    (1, -2, -3): "in OpenGL's or Blender's camera axes (y up, z towards the camera)",
    (1, -2, 3): "with y up",
    (-1, 2, 3): "with x to the left",
    (1, 2, -3): "with z towards the camera",
    (-1, -2, -3): "pointing into the subject",
    (3, 2, 1): "in the order blue, green, red",
}


@dataclass(frozen=True, kw_only=True)
class _Moments:
    """Mean outer products of stored normals with the directions that they should have."""

    camera: Float[np.ndarray, "3 3"]
    world: Float[np.ndarray, "3 3"]


def check_normal_axes(
    folder: Path, samples: Sequence[ViewSample], cameras: Sequence[Camera], stated: NormalsFrame = "camera_opencv"
) -> list[str]:
    """Compare the axes of all normal maps with those that agree best with the outlines and the viewing directions.

    Args:
        folder: of the normal maps, for messages.
        samples: of the views, as the next.
        cameras: of the views.
        stated: the axes that the maps are said to have; samples are converted from these.

    Returns:
        Warnings about single views.

    Raises:
        InputError: other axes agree better in all views together.
    """
    _check_encoding(folder, samples)
    moments = {
        sample.name: found
        for sample, camera in zip(samples, cameras, strict=True)
        if (found := _moments(sample, camera)) is not None
    }
    if not moments:
        return []
    total = _Moments(
        camera=np.mean([m.camera for m in moments.values()], axis=0),
        world=np.mean([m.world for m in moments.values()], axis=0),
    )
    (axes, world), better = _best(total)
    if better > _MARGIN:
        given = float(np.trace(total.camera))
        raise refuse(
            "normals-axes",
            "The normals are in other axes",
            where=folder,
            expected="the camera's frame: x right, y down, z away from the camera, so that z < 0 where it sees",
            got=f"normals {_name(axes, world)}: these agree with outlines and viewing directions by "
            f"{_share(given + better)}, the camera's axes by {_share(given)}",
            fix=_mend(axes, world, stated),
            mend=_fix(axes, world, stated),
        )
    warnings = []
    for name, found in moments.items():
        (axes, world), better = _best(found)
        if better > 2 * _MARGIN and not world:
            warnings.append(f"{name}: its normals seem to be {_name(axes, world)}; {_conversion(axes, world)}")
    return warnings


def _check_encoding(folder: Path, samples: Sequence[ViewSample]) -> None:
    """Refuse normals that are not of unit length, or all equal. Raises InputError."""
    found = [sample.normals[sample.subject] for sample in samples if sample.normals is not None]
    normals = np.concatenate([np.zeros((0, 3)), *found])
    lengths = np.linalg.norm(normals, axis=-1)
    normals, lengths = normals[lengths > 0.01], lengths[lengths > 0.01]
    if len(normals) < _MIN_PIXELS:
        return
    median, spread = float(np.median(lengths)), float(np.linalg.norm(normals - normals.mean(0), axis=-1).mean())
    small = bool((normals < 2 / 256 - 1).all())
    if not _LENGTHS[0] <= median <= _LENGTHS[1]:
        got = f"a length of {median:.2f} in the median"
        raise _wrong_encoding(folder, got + (": no value above 255 of 65535" if small else ""))
    if spread < _VARIATION:
        raise _wrong_encoding(folder, "the same normal everywhere")


def _wrong_encoding(folder: Path, got: str) -> FindingError:
    return refuse(
        "normals-encoding",
        "The normal maps are encoded otherwise",
        where=folder,
        expected="16 bit RGB, n = 2 v / 65535 - 1 with unit normals n",
        got=got,
        fix="encode them again from normals as floating-point numbers",
    )


def _moments(sample: ViewSample, camera: Camera) -> _Moments | None:
    if sample.normals is None:
        return None
    length = np.linalg.norm(sample.normals, axis=-1)
    has_normal = (length > _MIN_LENGTH) & sample.subject
    normals = sample.normals / np.maximum(length, 1e-6)[..., None]
    # A mask that is another image's says nothing about these normals.
    shown = (sample.normals != 0).any(-1)
    silhouette = sample.subject if overlap(sample.subject, shown) > _SAME else shown
    outward, rim = _outline(silhouette)
    rim &= has_normal
    if rim.sum() < _MIN_RIM or has_normal.sum() < _MIN_PIXELS:
        return None
    # At the outline the direction is that away from the subject in the image, elsewhere that to the camera.
    at_rim = np.concatenate([outward[rim], np.zeros((int(rim.sum()), 1))], -1)
    facing = normals[has_normal].T @ -sample.rays[has_normal] / has_normal.sum()
    outlined = normals[rim].T @ at_rim / rim.sum()
    moment = facing + outlined
    return _Moments(camera=moment, world=moment @ camera.T_cam_world[:3, :3])


def _outline(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions out of a region in the image (h, w, 2), and its pixels at its outline, not at the image's border."""
    padded = cv2.copyMakeBorder(inside.astype(np.uint8), _RIM, _RIM, _RIM, _RIM, cv2.BORDER_REPLICATE)
    size = 2 * _RIM + 1
    rim = inside & ~cv2.erode(padded, np.ones((size, size), np.uint8))[_RIM:-_RIM, _RIM:-_RIM].astype(bool)
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 2.0 * _RIM, borderType=cv2.BORDER_REPLICATE)
    down, right = np.gradient(smooth)
    outward = -np.stack([right, down], -1)
    return outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-6), rim


def _best(moments: _Moments) -> tuple[tuple[tuple[int, ...], bool], float]:
    """The axes that agree best, whether of the world, and by how much better than the camera's as they are."""
    candidates = {}
    for axes in _AXES:
        matrix = _matrix(axes)
        candidates[axes, False] = float(np.sum(matrix * moments.camera.T))
        candidates[axes, True] = float(np.sum(matrix * moments.world.T))
    best = max(candidates, key=lambda key: candidates[key])
    return best, candidates[best] - candidates[(1, 2, 3), False]


# Signed permutations: (1, -2, -3) stands for (x, -y, -z).
_AXES = [
    tuple(int(sign * axis) for sign, axis in zip(signs, order, strict=True))
    for order in permutations((1, 2, 3))
    for signs in product((1, -1), repeat=3)
]


def _matrix(axes: tuple[int, ...]) -> Float[np.ndarray, "3 3"]:
    """The matrix that maps stored normals to these axes."""
    matrix = np.zeros((3, 3))
    for row, axis in enumerate(axes):
        matrix[row, abs(axis) - 1] = np.sign(axis)
    return matrix


def _name(axes: tuple[int, ...], world: bool) -> str:
    if world:
        return "in the world's frame" + ("" if axes == (1, 2, 3) else f", as {_formula(axes)} of the capture's")
    return _NAMES.get(axes, f"as {_formula(axes)}")


def _frame(axes: tuple[int, ...], world: bool, stated: NormalsFrame) -> NormalsFrame | None:
    """The axes that capture.toml should state; None if no statement makes the maps right."""
    opposite: dict[NormalsFrame, NormalsFrame] = {"camera_opencv": "camera_opengl", "camera_opengl": "camera_opencv"}
    frame = opposite.get(stated) if not world and axes == (1, -2, -3) else None
    return "world" if world and stated == "camera_opencv" and axes == (1, 2, 3) else frame


def _mend(axes: tuple[int, ...], world: bool, stated: NormalsFrame) -> str:
    """The right statement in capture.toml, if there is one, or how to convert the maps."""
    frame = _frame(axes, world, stated)
    statement = [] if frame is None else [f'write [normals] frame = "{frame}" into capture.toml']
    if stated == "camera_opencv":
        return ", or ".join([*statement, _conversion(axes, world)])
    return (statement or [f'correct [normals] frame = "{stated}" in capture.toml'])[0]


def _fix(axes: tuple[int, ...], world: bool, stated: NormalsFrame) -> Fix | None:
    """The statement that is right, or else the conversion of the maps."""
    matrix = _matrix(axes)
    if (frame := _frame(axes, world, stated)) is not None:
        return NormalFrameFix(what=f'wrote [normals] frame = "{frame}"', frame=frame, matrix=matrix, world=world)
    if stated != "camera_opencv":
        return None
    return NormalFix(what=f"converted normals {_name(axes, world)}", matrix=matrix, world=world)


def _conversion(axes: tuple[int, ...], world: bool) -> str:
    if world:
        return f"multiply ({_formula(axes)}) by the rotation of each view's pose, world to camera"
    return f"store ({_formula(axes)}) in place of (x, y, z)"


def _formula(axes: tuple[int, ...]) -> str:
    return ", ".join(("-" if axis < 0 else "") + "xyz"[abs(axis) - 1] for axis in axes)


def _share(agreement: float) -> str:
    return f"{max(0.0, agreement / 2):.0%}"
