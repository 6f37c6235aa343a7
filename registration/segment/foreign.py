"""Hair, beard, glasses and clothes: what belongs to the subject and not to the model.

Per vertex, over all views: what does not look like the person's own skin, where hair, beards and clothes may be, and
what stereo sees in front of the fitted surface. Per pixel: that, interpolated, and what reaches beyond the fitted
silhouette.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from registration.capture.class_names import BACKGROUND, NECK
from registration.frames import srgb_to_linear
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.render.studio.skin import depth_inside_hairline
from registration.segment.fitted import BEARD, CLOTH, GLASSES, HAIR, INDEX, FittedHead, FittedView
from registration.segment.mattes import connected
from registration.segment.skin_colour import SkinDifference, skin_difference
from registration.segment.views import SegmentView, depth_in, ellipse
from registration.stereo.depth_map import DepthMap

_ROUNDS = 6  # of averaging over neighbours: about 10 mm
_LOOK = {
    HAIR: 1.6,
    BEARD: 1.6,
    CLOTH: 2.2,
    GLASSES: 1.6,
}  # mean difference from skin, in its standard deviations, of each kind
_BRIGHTER = 0.4  # weight of what is brighter than skin
_FRINGE = 1.5  # times the limit, on the forehead and temples: hair may hang there
_FRINGE_M = 0.03  # how far below the hairline
_LEAST_M2 = {HAIR: 6e-4, BEARD: 3e-4, CLOTH: 6e-4, GLASSES: 2e-4}  # smaller patches are stains
_FRONT_M = {HAIR: 4e-3, BEARD: 4e-3, CLOTH: 5e-3, GLASSES: 4e-3}  # in front of the surface, beside the fit's error
_MOST_FRONT = 3.0  # times `_FRONT_M`: more counts no more
_DEPTH_CONFIDENCE = 0.5
_LEAST_COSINE = 0.4
_DEPTH_VIEWS = 2
_BRIGHTNESS, _TINT = 0.7, 0.15  # natural logarithms: what differs less continues the skin beside it
_DARKEST = 2e-3  # linear light: below it there is no colour
_TOO_FAR_M = 0.03  # in front: another object
_BEARD_REGIONS = (
    *("chin_region", "upper_lip_region", "lower_lip_region", "left_cheek_region", "right_cheek_region"),
    *("left_parotid_region", "right_parotid_region"),
)
_BROWS = ("left_brow_region", "middle_brow_region", "right_brow_region", "left_orbital_region", "right_orbital_region")
_GLASSES_REGIONS = ("orbital", "infraorbital", "temple")


@dataclass(frozen=True, kw_only=True, eq=False)
class Foreign:
    """What covers the model's skin, per vertex."""

    shares: dict[str, Float[np.ndarray, "V"]]  # class -> in [0, 1]
    difference: SkinDifference
    in_front_m: Float[np.ndarray, "V"]  # what stereo sees before the fitted surface, along its normal; NaN: nothing


def foreign_vertices(
    head: FittedHead,
    views: Sequence[SegmentView],
    subjects: Sequence[Bool[np.ndarray, "_ _"]],
    depths: Sequence[DepthMap | None] | None = None,
    accuracy_m: float = 1.5e-3,
) -> Foreign:
    """Return which parts of a fitted head are covered.

    Args:
        head: fitted to within `accuracy_m`.
        views: windows of the photographs, at a working resolution.
        subjects: what surely shows the subject in each; of their sizes.
        depths: of stereo, for the same views; optional.
        accuracy_m: typical distance of the fitted surface from the true one.
    """
    difference = skin_difference(head, views, subjects)
    front = _in_front(head, views, depths or [None] * len(views))
    places = _places(head.data)
    weight = (difference.seen > 0).astype(np.float64)
    darker = head.smoothed(-difference.brightness, weight, _ROUNDS)
    look = {
        name: head.smoothed(value, weight, _ROUNDS)
        for name, value in (
            # Dark hair is the rule; skin that is brighter than predicted is mostly better lit.
            ("brightness", np.where(difference.brightness < 0, 1, _BRIGHTER) * np.abs(difference.brightness)),
            ("colour", difference.colour),
            ("grain", np.maximum(difference.grain, 0)),
        )
    }
    total = (look["brightness"] + look["colour"] + look["grain"]) / 2
    clothing = (look["brightness"] * 0.5 + look["colour"] * 1.5) / 2
    measured = np.isfinite(front)
    offset = head.smoothed(np.where(measured, front, 0), measured.astype(np.float64), 3)
    evidence = {
        HAIR: np.maximum(total, 0) / _LOOK[HAIR],
        BEARD: np.where(darker + look["grain"] > 0.5, total, 0) / _LOOK[BEARD],
        CLOTH: clothing / _LOOK[CLOTH],
        GLASSES: total / _LOOK[GLASSES],
    }
    shares = {}
    for name, value in evidence.items():
        # What looks like skin and lies in front of the fitted surface is skin, and the fit is wrong.
        front_share = np.clip((offset - accuracy_m) / _FRONT_M[name], 0, _MOST_FRONT)
        value = value * (front_share if name == GLASSES else 1 + front_share)
        root = places[HAIR] == 1 if name == HAIR else None
        share = _patches(head, np.clip(value * places[name] - 0.5, 0, 1), _LEAST_M2[name], root)
        shares[name] = share
    return Foreign(shares=_exclusive(shares), difference=difference, in_front_m=front)


def _places(data: GNMData) -> dict[str, Float[np.ndarray, "V"]]:
    """Where each kind may be: factors of its evidence in [0, 1]."""
    exterior, neck = regions.exterior(data), regions.neck_other(data)
    inside = depth_inside_hairline(data)
    low = _lowest_scalp(data)
    height = data.template_vertex_positions[:, 1]
    fringe = (inside > -_FRINGE_M) & (height > low)
    scalp = np.where(inside > 0, 1.0, np.where(fringe, 1 / _FRINGE, 0.0))
    ears = regions.ears(data)
    scalp = np.where(ears, 1 / _FRINGE, scalp) * exterior * ~neck
    brows = np.max([regions.group(data, name) for name in _BROWS], axis=0) > 0.2
    scalp *= ~brows
    beard = np.max([regions.group(data, name) for name in _BEARD_REGIONS], axis=0) > 0.5
    lips = np.max([regions.group(data, name) for name in ("upper_lip", "lower_lip")], axis=0) > 0.5
    jaw = exterior & ~neck & ~ears & (height < data.template_vertex_positions[lips, 1].mean())
    beard = (beard | jaw) & ~lips & ~ears & exterior & (inside < 0)
    sides = [regions.group(data, f"{side}_{name}_region") for side in ("left", "right") for name in _GLASSES_REGIONS]
    glasses = (np.max(sides, axis=0) > 0.5) & exterior & (regions.lids(data) < 0.5)
    return {
        HAIR: scalp,
        BEARD: beard.astype(np.float64),
        CLOTH: neck.astype(np.float64),
        GLASSES: glasses.astype(np.float64),
    }


def _lowest_scalp(data: GNMData) -> float:
    """Height in the template below which there is no fringe: the middle of the eyes."""
    eyes = np.maximum(regions.group(data, "left_eye"), regions.group(data, "right_eye")) > 0.5
    return float(data.template_vertex_positions[eyes, 1].mean()) if eyes.any() else 0.0


def _in_front(
    head: FittedHead, views: Sequence[SegmentView], depths: Sequence[DepthMap | None]
) -> Float[np.ndarray, "V"]:
    """Median over the views of what stereo sees before each vertex, metres along its normal; NaN where few see it."""
    found = np.full((len(views), len(head.vertices)), np.nan, np.float32)
    for number, (view, depth) in enumerate(zip(views, depths, strict=True)):
        if depth is None:
            continue
        rows = head.seen(view.camera, _LEAST_COSINE)
        xy, distance = view.camera.project(head.vertices[rows])
        seen = depth_in(depth, view.camera, _DEPTH_CONFIDENCE)
        column, row = np.floor(xy).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < view.camera.width_px) & (row < view.camera.height_px)
        rows, column, row, distance = rows[inside], column[inside], row[inside], distance[inside]
        towards = view.camera.centre - head.vertices[rows]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        front = (distance - seen[row, column]) * (towards * head.normals[rows]).sum(1)
        valid = (seen[row, column] > 0) & (np.abs(front) < _TOO_FAR_M)
        found[number, rows[valid]] = front[valid]
    result = np.full(len(head.vertices), np.nan)
    enough = np.isfinite(found).sum(0) >= _DEPTH_VIEWS
    if enough.any():
        result[enough] = np.nanmedian(found[:, enough], axis=0)
    return result


def _patches(
    head: FittedHead, share: Float[np.ndarray, "V"], least_m2: float, root: Bool[np.ndarray, "V"] | None = None
) -> Float[np.ndarray, "V"]:
    """Drop connected patches of too little area, in all or of the part where they must have their root."""
    members = share > 0.5
    if not members.any():
        return np.zeros_like(share)
    a, b = head.edges[members[head.edges].all(1)].T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(share), len(share)))
    patch = connected_components(graph, directed=False)[1]
    counted = members if root is None else members & root
    area = np.bincount(patch[counted], vertex_areas(head.vertices, head.triangles)[counted], patch.max() + 1)
    kept = members & (area[patch] >= least_m2)
    return head.smoothed(kept.astype(np.float64), np.ones(len(share)), 1)


def _exclusive(shares: dict[str, Float[np.ndarray, "V"]]) -> dict[str, Float[np.ndarray, "V"]]:
    """Where several kinds are claimed, the larger one holds."""
    stacked = np.stack(list(shares.values()))
    largest = stacked == stacked.max(0)
    return {name: value * largest[number] for number, (name, value) in enumerate(shares.items())}


def foreign_pixels(
    image: UInt8[np.ndarray, "H W 3"],
    head: FittedHead,
    view: FittedView,
    foreign: Foreign,
    subject: Bool[np.ndarray, "H W"],
    tolerance_px: float,
) -> Int[np.ndarray, "H W"]:
    """Return the labels of a view with all that is foreign, before borders inside the face are refined.

    Args:
        image: of the view.
        head: fitted.
        view: of it.
        foreign: what covers its vertices.
        subject: where the mask says so.
        tolerance_px: how far the fitted silhouette may be from the skin's.
    """
    labels = view.labels.copy()
    covered = np.zeros(labels.shape, bool)
    for name, share in foreign.shares.items():
        if share.any():
            here = head.at_pixels(share, view) > 0.5
            labels[here] = INDEX[name]
            covered |= here
    outside = subject & ~view.inside
    nearest, unlike = _beyond(image, labels, view.inside, outside, tolerance_px)
    distance = cv2.distanceTransform((~view.inside).astype(np.uint8), cv2.DIST_L2, 5)
    far = connected(outside & unlike, outside & unlike & (distance > tolerance_px))
    below = np.isin(nearest, [INDEX[NECK], INDEX[CLOTH]])
    labels[outside] = nearest[outside]
    labels[far] = np.where(below, INDEX[CLOTH], INDEX[HAIR])[far]
    labels[~subject] = INDEX[BACKGROUND]
    return _widened(labels, covered | far, tolerance_px / 2)


def _beyond(
    image: UInt8[np.ndarray, "H W 3"],
    labels: Int[np.ndarray, "H W"],
    inside: Bool[np.ndarray, "H W"],
    outside: Bool[np.ndarray, "H W"],
    reach_px: float,
) -> tuple[Int[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """What lies beyond the silhouette: the label of its nearest pixel, and whether it looks different from there."""
    core = cv2.erode(inside.astype(np.uint8), ellipse(reach_px)) > 0
    if not core.any():
        return labels, outside
    _, number = cv2.distanceTransformWithLabels(
        (~core).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(number.max() + 1, np.int64)
    table[number[core]] = np.flatnonzero(core)
    source = table[number]
    # Means over the subject alone: the background must not shine in.
    weight = (inside | outside).astype(np.float32)
    side = max(3, round(reach_px)) | 1
    share = np.maximum(cv2.boxFilter(weight, -1, (side, side)), 1e-6)[..., None]
    linear = (srgb_to_linear(image.astype(np.float32) / 255) + _DARKEST) * weight[..., None]
    logs = np.log(np.maximum(cv2.boxFilter(linear, -1, (side, side)) / share, _DARKEST))
    change = logs - logs.reshape(-1, 3)[source]
    tint = change - change.mean(-1, keepdims=True)
    unlike = (np.abs(change.mean(-1)) > _BRIGHTNESS) | (np.abs(tint).max(-1) > _TINT)
    return labels.ravel()[source], np.asarray(unlike)


def _widened(
    labels: Int[np.ndarray, "H W"], foreign: Bool[np.ndarray, "H W"], width_px: float
) -> Int[np.ndarray, "H W"]:
    """Foreign regions a little larger, on skin only."""
    result = labels.copy()
    skin = np.isin(labels, [INDEX[name] for name in ("skin", "ears", NECK)])
    for name in (HAIR, BEARD, CLOTH, GLASSES):
        grown = cv2.dilate((labels == INDEX[name]).astype(np.uint8), ellipse(width_px)) > 0
        result[grown & skin & ~foreign] = INDEX[name]
    return result
