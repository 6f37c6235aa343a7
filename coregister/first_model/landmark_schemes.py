"""Landmark schemes of the first model: the iBUG `68`, `dense` on the skin, `oral` on teeth and tongue."""

import numpy as np
from jaxtyping import Int

from coregister.first_model import teeth
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.skin import front_points
from registration.model.landmarks import LandmarkScheme

DENSE_COUNT = 300
# The subject's left half and the midline of the 68, in a front view of MakeHuman's base mesh: number -> x, y in mm.
_LEFT_68 = {
    **{8: (0, 192), 9: (20, 197), 10: (36, 208), 11: (48, 221.5), 12: (57.5, 237), 13: (64.5, 255), 14: (68, 270)},
    **{15: (70, 286), 16: (70.5, 302)},  # jaw line
    **{22: (12, 318), 23: (20, 323), 24: (30, 325), 25: (40, 323.5), 26: (49, 318)},  # brow
    **{27: (0, 304), 28: (0, 293), 29: (0, 282), 30: (0, 268), 33: (0, 257), 34: (6, 257.5), 35: (12, 259)},  # nose
    **{42: (17.5, 302), 43: (26.5, 307), 44: (37.5, 307.4), 45: (44, 303.7), 46: (38, 299.3), 47: (26.5, 299.4)},  # eye
    **{51: (0, 245), 52: (7, 246), 53: (16, 243.5), 54: (24.8, 235.8), 55: (17, 228.5), 56: (8, 226.2)},  # lips
    **{57: (0, 225.5)},
    **{62: (0, 236.4), 63: (9, 236.9), 64: (24.2, 235.8), 65: (9, 234.9), 66: (0, 234.9)},  # inner lips
}
_RIGHT_68 = {
    **{16 - n: n for n in range(9, 17)},
    **{17 + n: 26 - n for n in range(5)},
    **{31: 35, 32: 34, 36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46},
    **{48: 54, 49: 53, 50: 52, 58: 56, 59: 55, 60: 64, 61: 63, 67: 65},
}
_SPARSITY = 2.0  # ratio of the spacing of dense landmarks off the face to that on it


def build_schemes(assembly: HeadAssembly) -> dict[str, LandmarkScheme]:
    """Return the three schemes by name; every landmark is a single vertex of the template."""
    vertices = {"68": _sixty_eight(assembly), "dense": _dense(assembly), "oral": _oral(assembly)}
    return {
        name: LandmarkScheme(name=name, indices=np.repeat(v[:, None], 3, 1), weights=np.tile([1.0, 0, 0], (len(v), 1)))
        for name, v in vertices.items()
    }


def _sixty_eight(assembly: HeadAssembly) -> Int[np.ndarray, "68"]:
    part = assembly.skin.part
    eligible = part.groups["skin_exterior"] & ~part.groups["ears"] & (part.vertices[:, 2] > 0.01)
    left = front_points(part.vertices, eligible, np.array(list(_LEFT_68.values())))
    vertices = np.full(68, -1)
    vertices[list(_LEFT_68)] = left
    for right, twin in _RIGHT_68.items():
        vertices[right] = part.mirror[vertices[twin]]
    return vertices


def _dense(assembly: HeadAssembly) -> Int[np.ndarray, "L"]:
    """Select vertices by symmetric farthest-point sampling of the head's exterior, denser on the face."""
    part = assembly.parts["skin"]
    rows = np.flatnonzero(assembly.stable_skin & (part.vertices[:, 0] > -1e-6))
    scale = np.where(part.groups["hockey_mask"][rows], 1.0, 1 / _SPARSITY)
    points = part.vertices[rows]
    chosen = [int(np.argmax(points[:, 2]))]
    distance = np.full(len(rows), np.inf)
    count = 0
    while True:
        on_midline = part.mirror[rows[chosen[-1]]] == rows[chosen[-1]]
        count += 1 if on_midline else 2
        if count >= DENSE_COUNT:
            break
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance * scale)))
    left = rows[np.array(chosen)]
    return np.unique(np.concatenate([left, part.mirror[left]]))


def _oral(assembly: HeadAssembly) -> Int[np.ndarray, "18"]:
    """Select six upper and six lower teeth, then six points of the tongue.

    Teeth from the subject's right to left: first molar, canine, incisor, incisor, canine, first molar. Tongue: tip,
    middle and back of its ridge, left margin, right margin, underside of the tip.
    """
    teeth_rows = []
    for name in ("upper_teeth_and_gums", "lower_teeth_and_gums"):
        rows = teeth.landmark_vertices(assembly.parts[name]).values()
        teeth_rows += [assembly.slices[name].start + v for v in rows]
    part = assembly.parts["tongue"]
    v = part.vertices
    along = (v[:, 2] - v[:, 2].min()) / np.ptp(v[:, 2])
    midline = part.mirror == np.arange(len(v))

    def top(fraction: float, sign: float = 1.0) -> int:
        near = np.flatnonzero(midline & (np.abs(along - fraction) < 0.06))
        return int(near[np.argmax(sign * v[near, 1])])

    left = int(np.argmax(np.where(np.abs(along - 0.7) < 0.06, v[:, 0], -np.inf)))
    tongue = [int(np.argmax(np.where(midline, v[:, 2], -np.inf))), top(0.75), top(0.5), left, int(part.mirror[left])]
    return np.array([*teeth_rows, *(assembly.slices["tongue"].start + np.array([*tongue, top(0.85, -1.0)]))])
