"""Procedural linear albedo of a head in the model's atlas, from solid noise at *template* positions.

A solid texture has no seams and stays fixed to the surface under every identity and expression. The colour of skin
depends on two pigments, melanin and haemoglobin, after [Tsumura 2003], each with its own variation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from registration.geometry.smoothstep import smoothstep
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, group
from registration.render.studio.canvas import Canvas, fill_texture, smoothed, soft_group
from registration.render.studio.eyes import SIDES, eye_frame, paint_eye
from registration.render.studio.noise import SolidNoise

_UNPIGMENTED = np.array([0.86, 0.78, 0.70])
_MELANIN = np.array([0.46, 0.76, 1.08])  # absorption per unit
_BLOOD = np.array([0.10, 0.66, 0.60])
_LIPS = np.array([0.80, 0.66, 0.80])  # further attenuation by the thinner skin of the lips
_FLUSH = {  # additional blood by vertex group
    "nose_region": 0.22,
    "left_cheek_region": 0.12,
    "right_cheek_region": 0.12,
    "left_infraorbital_region": 0.22,
    "right_infraorbital_region": 0.22,
    "ears": 0.30,
    "chin_region": 0.10,
    "left_orbital_region": 0.08,
    "right_orbital_region": 0.08,
}
_BEARD_REGIONS = ("chin_region", "upper_lip_region", "lower_lip_region", "left_cheek_region", "right_cheek_region")
_LASHES_M = (0.0026, 0.0016)  # distance from the eyeball where lids begin to darken, and where they are dark
_BROW_M = 0.0042  # largest half height of a brow
_BROW_HAIRS, _HAIR_M, _STRAND_M = 380, 0.0070, 0.00016  # number, length, half a hair's width


@dataclass(frozen=True, kw_only=True)
class SkinAppearance:
    """Colour and details of a head. Colours are linear albedo."""

    seed: int = 0
    melanin: float = 0.7  # 0.2 very light to 2.2 very dark
    blood: float = 0.30
    unevenness: float = 1.0  # variation of the pigments; 0: none
    freckles: float = 0.35  # 0 to 1
    stubble: float = 0.25  # 0 to 1
    hair: tuple[float, float, float] = (0.055, 0.032, 0.018)
    iris: tuple[float, float, float] = (0.16, 0.21, 0.20)

    @classmethod
    def sample(cls, seed: int) -> "SkinAppearance":
        """Sample the appearance of a person."""
        rng = np.random.default_rng([seed, 5])
        melanin = float(rng.uniform(0.25, 2.0))
        fair = rng.random() < 0.6 * max(0.0, 1 - melanin / 0.8)  # light hair and eyes are correlated with light skin
        darkness = rng.uniform(0.6, 1.4)
        hair = np.array([0.16, 0.10, 0.045] if fair else [0.045, 0.027, 0.016]) * darkness
        brown, light = np.array([0.085, 0.045, 0.02]), np.array([0.16, 0.21, 0.22]) * rng.uniform(0.7, 1.2, 3)
        return cls(
            seed=seed,
            melanin=melanin,
            blood=float(rng.uniform(0.2, 0.4)),
            freckles=float(rng.uniform(0, 0.8) * np.exp(-melanin)),
            stubble=float(max(0.0, rng.uniform(-0.5, 0.8))),
            hair=(float(hair[0]), float(hair[1]), float(hair[2])),
            iris=tuple((light if fair or rng.random() < 0.2 else brown * darkness).tolist()),
        )


def depth_inside_hairline(data: GNMData) -> Float[np.ndarray, "V"]:
    """Return the distance of the template's vertices from the hairline inside it, metres; negative outside.

    Hair grows on exterior skin outside the face mask and the ears: behind the ears above their lower end, in front of
    them above their upper end.
    """
    points = data.template_vertex_positions.astype(np.float64)
    face, ears = (group(data, name) > 0.5 for name in ("hockey_mask", "ears"))
    depth = cKDTree(points[face]).query(points)[0] - 0.002
    if ears.any():
        depth = np.minimum(depth, cKDTree(points[ears]).query(points)[0] - 0.006)
        low, high = points[ears].min(0), points[ears].max(0)
        sideburn = smoothstep((low[2] + high[2]) / 2, high[2], points[:, 2])
        depth = np.minimum(depth, points[:, 1] - low[1] - sideburn * (0.8 * (high[1] - low[1])))
    return np.where(exterior(data) & ~face & ~ears, depth, np.minimum(depth, -0.002))


def paint_head(data: GNMData, canvas: Canvas, look: SkinAppearance) -> Float[np.ndarray, "R R 3"]:
    """Return the head's texture. A Mitsuba variant must be active.

    Args:
        data: the head model.
        canvas: of its atlas.
        look: colours and details.

    Returns:
        Linear albedo.
    """
    template = data.template_vertex_positions
    colours = np.zeros((canvas.size * canvas.size, 3), np.float32)
    names = data.mesh_component_names.tolist()
    for name in names:
        part = canvas.select(group(data, name) > 0.5)
        points = part.interpolate(template)
        if name in SIDES:
            colours[part.texel] = paint_eye(eye_frame(data, name), points, look.iris, look.seed)
        elif name == "skin":
            colours[part.texel] = _skin(data, part, points, look)
        else:
            colours[part.texel] = _mouth(data, part, points, look.seed)
    return fill_texture(canvas.size, canvas.texel, colours[canvas.texel])


def _skin(
    data: GNMData, canvas: Canvas, points: Float[np.ndarray, "T 3"], look: SkinAppearance
) -> Float[np.ndarray, "T 3"]:
    noise, seed, uneven = SolidNoise(points), 100 * look.seed, look.unevenness
    melanin = 1 + uneven * (
        0.10 * noise.smooth(0.055, seed + 1)
        + 0.07 * noise.smooth(0.016, seed + 2, octaves=2)
        + 0.06 * noise.smooth(0.0035, seed + 3, octaves=2)
    )
    blood = 1 + uneven * (
        0.10 * noise.smooth(0.040, seed + 4)
        + 0.11 * noise.smooth(0.010, seed + 5, octaves=2)
        + 0.12 * noise.smooth(0.0028, seed + 6, octaves=2)
    )
    melanin = (
        look.melanin + min(look.melanin, 0.6) * np.clip(melanin - 1, -0.7, 1) + look.freckles * _freckles(noise, seed)
    )
    melanin += _moles(noise, seed)
    blood = look.blood * np.clip(blood, 0.2, 2.5)
    flush = sum(
        (amount * soft_group(data, name, 14) for name, amount in _FLUSH.items()),
        np.zeros(len(data.template_vertex_positions)),
    )
    blood += canvas.interpolate(flush) * (1 + 0.25 * uneven * noise.smooth(0.012, seed + 7))
    lips = _lips(data, canvas)
    wrinkles = noise.smooth(0.0011, seed + 8, octaves=2)
    blood = blood * (1 - lips) + lips * (1.05 + 0.12 * wrinkles)
    melanin = melanin * (1 - lips) + lips * (0.9 * look.melanin + 0.10)
    lining = canvas.interpolate(1.0 * ~exterior(data)) * (1 - canvas.interpolate(soft_group(data, "eye_sockets", 1)))
    blood += 0.9 * lining
    colour = _UNPIGMENTED * np.exp(-melanin[:, None] * _MELANIN - blood[:, None] * _BLOOD)
    colour *= 1 - lips[:, None] * (1 - _LIPS)
    colour *= _pores(noise, seed, uneven * (1 - lips))[:, None]
    for cover, darkness in (
        (_stubble(data, canvas, noise, look), 0.75),
        (_lashes(data, points), 0.85),
        (_brows(data, canvas, points, look.seed), 0.9),
    ):
        colour += (cover * darkness)[:, None] * (np.array(look.hair) - colour)
    return colour.astype(np.float32)


def _freckles(noise: SolidNoise, seed: int) -> Float[np.ndarray, "T"]:
    distance, number = noise.dots(0.0062, seed + 20)
    size = 0.0006 + 0.0012 * number
    patchy = smoothstep(-0.6, 1.2, noise.smooth(0.035, seed + 21))
    return 0.55 * smoothstep(1.1, 0.3, distance / size) * (number > 0.35) * patchy


def _moles(noise: SolidNoise, seed: int) -> Float[np.ndarray, "T"]:
    distance, number = noise.dots(0.030, seed + 22)
    size = 0.0006 + 0.0010 * (number % 0.1) * 10
    return 2.2 * smoothstep(1.15, 0.75, distance / size) * (number > 0.55)


def _pores(noise: SolidNoise, seed: int, strength: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Return the shading factor of pores of half a millimetre and the fine lines between them."""
    distance, number = noise.dots(0.0014, seed + 23)
    pore = smoothstep(0.00048, 0.00010, distance) * (0.35 + 0.65 * number)
    grain = noise.smooth(0.0009, seed + 24, octaves=2)
    return np.clip(1 - strength * (0.20 * pore + 0.028 * grain), 0.3, 1.2)


def _lips(data: GNMData, canvas: Canvas) -> Float[np.ndarray, "T"]:
    both = np.maximum(group(data, "upper_lip"), group(data, "lower_lip")).astype(np.float64)
    # The oral lining continues the lips, so that they do not fade where they meet.
    inner = np.maximum(both, group(data, "mouth_sock"))
    return smoothstep(0.32, 0.68, canvas.interpolate(smoothed(data, inner, 3)))


def _stubble(data: GNMData, canvas: Canvas, noise: SolidNoise, look: SkinAppearance) -> Float[np.ndarray, "T"]:
    if look.stubble <= 0:
        return np.zeros(len(canvas.texel), np.float32)
    beard = np.max([soft_group(data, name, 6) for name in _BEARD_REGIONS], axis=0)
    lips = np.max([soft_group(data, name, 2) for name in ("upper_lip", "lower_lip")], axis=0)
    beard = smoothed(data, beard * (1 - np.clip(3 * lips, 0, 1)), 4) * (1 - np.clip(3 * lips, 0, 1))
    distance, number = noise.dots(0.0011, 100 * look.seed + 25)
    hairs = smoothstep(0.00042, 0.00012, distance) * (0.4 + 0.6 * number)
    return look.stubble * canvas.interpolate(beard) * (0.25 + 0.75 * hairs) * 0.8


def _lashes(data: GNMData, points: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T"]:
    """Return the coverage of a dark line where the lids touch the eyeball, thicker above the eye."""
    cover = np.zeros(len(points), np.float32)
    for side in SIDES:
        frame = eye_frame(data, side)
        height, _, angle = frame.cylindrical(points.astype(np.float64))
        gap = np.linalg.norm(points - frame.centre, axis=1) - frame.radius
        above = smoothstep(-0.1, 0.35, np.sin(angle))
        line = smoothstep(*_LASHES_M, gap) * (height > 0)
        cover = np.maximum(cover, line * (0.25 + 0.75 * above))
    return cover


def _brows(data: GNMData, canvas: Canvas, points: Float[np.ndarray, "T 3"], seed: int) -> Float[np.ndarray, "T"]:
    """Return the coverage of short strokes along an arc through each brow region, in the arc's unrolled plane."""
    cover = np.zeros(len(points), np.float32)
    template = data.template_vertex_positions.astype(np.float64)
    for number, (name, sign) in enumerate((("left_brow_region", 1.0), ("right_brow_region", -1.0))):
        region = template[group(data, name) > 0.5] * (sign, 1, 1)
        if len(region) < 3:
            continue
        degree = min(2, len(np.unique(region[:, 0].round(4))) - 1)
        arc, depth = np.polyfit(region[:, 0], region[:, 1], degree), np.polyfit(region[:, 0], region[:, 2], degree)
        low, high = np.percentile(region[:, 0], (4, 80))  # the region extends beyond the hairs
        x = np.linspace(low - _HAIR_M, high + _HAIR_M, 96)
        y = np.polyval(arc, x) + 0.12 * np.ptp(region[:, 1])
        along = np.r_[0, np.cumsum(np.linalg.norm(np.diff([x, y, np.polyval(depth, x)], axis=1), axis=0))]
        along -= np.interp(low, x, along)
        near = np.flatnonzero(canvas.interpolate(soft_group(data, name, 2)) > 0.02)
        local = points[near] * (sign, 1, 1)
        flat = np.stack([np.interp(local[:, 0], x, along), local[:, 1] - np.interp(local[:, 0], x, y)], 1)
        strokes = _strokes(flat, np.interp(high, x, along), np.random.default_rng([seed, 6, number]))
        cover[near] = np.maximum(cover[near], strokes * ((local[:, 0] > x[0]) & (local[:, 0] < x[-1])))
    return cover


def _strokes(points: Float[np.ndarray, "N 2"], length: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:
    """Return the coverage by hair of points (m) along and across a brow of a given length (m)."""
    s = rng.uniform(0.02, 0.93, _BROW_HAIRS)
    width = _BROW_M * np.sin(np.pi * np.clip(0.18 + 0.82 * s, 0, 1)) ** 0.7 * (1 - 0.45 * s)
    t = width * rng.uniform(-1, 1, _BROW_HAIRS)
    # Upwards at the nose, then along the brow; upper hairs lean towards the lower ones.
    angle = np.radians(62 * (1 - s) ** 1.5 + 6 - 22 * s * (t / _BROW_M) + rng.normal(0, 9, _BROW_HAIRS))
    hair_length = _HAIR_M * rng.uniform(0.6, 1.1, _BROW_HAIRS) * np.where(s < 0.1, 0.7, 1)
    step = np.linspace(0, 1, 40)
    bend = angle[:, None] - np.radians(18) * step
    x = (s * length)[:, None] + hair_length[:, None] * np.cumsum(np.cos(bend), 1) / 40
    y = (t - 0.25 * width)[:, None] + hair_length[:, None] * np.cumsum(np.sin(bend), 1) / 40
    taper = np.tile(1 - 0.75 * step, (_BROW_HAIRS, 1))
    strands = cKDTree(np.stack([x.ravel(), y.ravel()], 1))
    distance, which = strands.query(points, distance_upper_bound=0.003)
    half = _STRAND_M * np.r_[taper.ravel(), 0.0][which]
    hair = smoothstep(1.0, 0.0, (distance - half) / 0.00030) * (half > 0)
    shadow = 0.32 * np.exp(-((np.minimum(distance, 0.01) / 0.0009) ** 2))
    return np.maximum(hair, shadow).astype(np.float32)


def _mouth(data: GNMData, canvas: Canvas, points: Float[np.ndarray, "T 3"], seed: int) -> Float[np.ndarray, "T 3"]:
    """Return the albedo of teeth, gums and tongue."""
    noise = SolidNoise(points)
    teeth = smoothstep(0.4, 0.6, canvas.interpolate(soft_group(data, "teeth", 0)))[:, None]
    stained = (1 + 0.05 * noise.smooth(0.006, 100 * seed + 30, octaves=2))[:, None]
    wet = (1 + 0.12 * noise.smooth(0.004, 100 * seed + 31, octaves=3))[:, None]
    mucosa = np.array([0.46, 0.17, 0.15]) * wet
    enamel = np.array([0.70, 0.64, 0.52]) * stained
    return np.clip(mucosa + teeth * (enamel - mucosa), 0, 0.95).astype(np.float32)
