"""The first model, from nothing but MakeHuman's CC0 head [GNM, Head Registration] ("a custom parametric model derived
from curated 3D head meshes"). Everything is deterministic; the result is an official GNM file with landmark schemes."""

import hashlib
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Float

from coregister import joints, region_masks
from coregister.first_model import assembly, eyes, landmark_schemes, makehuman, population, tongue
from coregister.first_model.assembly import COMPONENTS, JOINTS, Anatomy
from coregister.first_model.makehuman import MakeHuman
from registration.geometry.pca import dense_components
from registration.geometry.quads import corner_triangles, triangles_of
from registration.model import gnm_npz, landmarks
from registration.model.fetch import cache_folder
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme

SEED = 20260401
IDENTITY_SAMPLES = 360
IDENTITY_SHARE = 0.995  # of the samples' variance
EXPRESSION_SAMPLES = 600
EXPRESSION_SHARE = 0.9999
TONGUE_SAMPLES = 400
TONGUE_SHARE = 0.99
FILE = "gnm_head_first.npz"
GROUPS = (
    *("skin", "skin_exterior", "left", "right", "hockey_mask", "upper_lip", "lower_lip", "mouth_sock", "tongue"),
    *("gums", "teeth", "upper_teeth_and_gums", "lower_teeth_and_gums", "eyes", "left_eye", "right_eye"),
    *("eye_sockets", "eye_interiors", "eye_exteriors", "scleras", "irises", "pupils", "ears"),
    *("expression_basis_left_eye", "expression_basis_right_eye", "expression_basis_mouth_nose_ears"),
    *("forehead_region", "left_brow_region", "middle_brow_region", "right_brow_region"),
    *("left_temple_region", "right_temple_region", "left_orbital_region", "right_orbital_region"),
    *("left_zygomatic_region", "right_zygomatic_region", "nose_region"),
    *("left_parotid_region", "right_parotid_region", "left_infraorbital_region", "right_infraorbital_region"),
    *("left_cheek_region", "right_cheek_region", "upper_lip_region", "lower_lip_region", "chin_region"),
)
# Face units that reach across the border of eyes and lower face are in both regions' samples.
_UPPER_UNITS = ("eye", "brow", "cheek", "noseSneer", "mouthSmile")
_NOT_LOWER_UNITS = ("brow", "eyeBlink", "eyeLook", "eyeWide")


def bootstrap(out: Path | None = None) -> Path:
    """The first model's file, with `head_sparse_{68,dense,oral}.txt` beside it; built once, then found in the cache.

    `out` asks for a copy there. Returns the path. Raises InputError if MakeHuman's head cannot be had.
    """
    cached = _cached_path()
    if not cached.is_file():
        _build_into(cached)
    if out is None:
        return cached
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    for file in sorted(cached.parent.iterdir()):
        target = out if file == cached else out.with_name(file.name)
        beside = target.with_name(f".{target.name}.{os.getpid()}.part")
        shutil.copyfile(file, beside)
        os.replace(beside, target)
    return out


def _code() -> bytes:
    """The sources that the model depends on: this package, and the geometry and bases that it uses."""
    here, geometry = Path(__file__).parent, Path(gnm_npz.__file__).parents[1] / "geometry"
    used = [here.parent / "joints.py", here.parent / "region_masks.py", *sorted(geometry.glob("*.py"))]
    return b"".join(file.read_bytes() for file in [*sorted(here.glob("*.py")), *used])


_CODE = _code()  # as imported: it may be edited while a process runs


def _cached_path() -> Path:
    """A place that changes with whatever the model depends on: the wheel, our own code, the numerical libraries."""
    libraries = " ".join(version(package) for package in ("numpy", "scipy"))
    origin = hashlib.sha256(_CODE + makehuman.SHA256.encode() + libraries.encode()).hexdigest()
    return cache_folder() / f"first-{origin[:16]}" / FILE


def _build_into(path: Path) -> None:
    """All files of the folder, which appears whole or not at all."""
    source = makehuman.read(makehuman.fetch())
    data, found = build(source)
    path.parent.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent.parent, prefix=".first-") as folder:
        fresh = Path(folder) / path.parent.name
        gnm_npz.write(data, fresh / path.name)
        for scheme in found.values():
            landmarks.write_scheme(scheme, fresh / path.name)
        try:
            fresh.rename(path.parent)
        except OSError:  # another process was first
            if not path.is_file():
                raise


def build(source: MakeHuman) -> tuple[GNMData, dict[str, LandmarkScheme]]:
    """The model and its landmark schemes."""
    made = assembly.make(source, population.mean_person())
    template = made.template
    identity, joint_identity = _identity_basis(made)
    # As in the official file, joints are what the regressor makes of the vertices, for every identity.
    regressor = _joint_regressor(made, identity["head"], joint_identity["head"])
    joint_identity["head"] = np.einsum("jv,kvd->kjd", regressor, identity["head"], optimize=True)
    masks = _masks(made)
    basis = _expression_basis(made, masks)
    groups = _groups(made, masks)
    quads = np.concatenate([part.quads + made.slices[name].start for name, part in made.parts.items()])
    quad_uvs = np.concatenate([part.quad_uvs for part in made.parts.values()])
    V, J = len(template), len(JOINTS)
    data = GNMData(
        version=np.array("3.0"),
        variant=np.array("head"),
        template_vertex_positions=template.astype(np.float32),
        template_joint_positions=(regressor @ template).astype(np.float32),
        vertex_identity_basis=np.concatenate(list(identity.values())).astype(np.float32),
        joint_identity_basis=np.concatenate(list(joint_identity.values())).astype(np.float32),
        expression_basis=np.concatenate(list(basis.values())).astype(np.float32),
        identity_names=_names(identity),
        joint_names=np.array(JOINTS),
        expression_names=_names(basis),
        joint_parent_indices=np.array([-1, 0, 1, 1], np.int32),
        skinning_weights=_skinning(made).astype(np.float32),
        quads=quads.astype(np.int32),
        triangles=triangles_of(quads).astype(np.int32),
        quad_uvs=quad_uvs.astype(np.float32),
        triangle_uvs=corner_triangles(quad_uvs).astype(np.float32),
        mesh_component_names=np.array(COMPONENTS),
        mirror_indices=made.mirror.astype(np.int32),
        joint_regressor=regressor.astype(np.float32),
        pose_correctives_regressor=np.zeros((9 * J, 3 * V), np.float16),
        bone_aligned_template_joint_orientations=np.tile(np.eye(3, dtype=np.float32), (J, 1, 1)),
        vertex_groups=np.stack([groups[name] for name in GROUPS]).astype(np.float32),
        vertex_group_names=np.array(GROUPS),
    )
    return data, landmark_schemes.make(made)


def _identity_basis(
    made: Anatomy,
) -> tuple[dict[str, Float[np.ndarray, "K V 3"]], dict[str, Float[np.ndarray, "K J 3"]]]:
    """Vertices and joints: PCA of sampled heads, then the eyeballs' own shape, both eyes alike."""
    rng = np.random.default_rng(SEED)
    moves = _Moves(made.source)
    heads = [made.person(population.model_person(made.source, rng), moves) for _ in range(IDENTITY_SAMPLES)]
    V = len(made.template)
    rows = np.stack([np.concatenate([v - made.template, j - made.joints]).ravel() for v, j in heads])
    # Symmetric people make a symmetric basis: their own mirror images add nothing.
    components, _ = dense_components(rows, IDENTITY_SHARE, centred=True)
    components = components.reshape(len(components), -1, 3)
    ball = eyes.variation()
    eyeballs = np.zeros((len(ball), V, 3))
    for name in ("left_eye", "right_eye"):
        eyeballs[:, made.slices[name]] = ball
    return (
        {"head": components[:, :V], "eye": eyeballs},
        {"head": components[:, V:], "eye": np.zeros((len(ball), len(JOINTS), 3))},
    )


class _Moves(dict[str, np.ndarray]):
    """Target -> displacement of the base mesh, read when first asked for."""

    def __init__(self, source: MakeHuman) -> None:
        super().__init__()
        self._source = source

    def __missing__(self, name: str) -> np.ndarray:
        self[name] = self._source.target(name)
        return self[name]


def _expression_basis(made: Anatomy, masks: Float[np.ndarray, "3 V"]) -> dict[str, Float[np.ndarray, "K V 3"]]:
    """By region name, in the file's order."""
    rng = np.random.default_rng(SEED + 1)
    names = sorted(name for name in made.source.targets if name.startswith("faceunits/") and "tongue" not in name)
    units = {name: made.expression(made.source.target(name)) for name in names}
    left = [n for n in names if n.split("/")[1].startswith(_UPPER_UNITS) and not n.endswith("Right")]
    lower = [n for n in names if not n.split("/")[1].startswith(_NOT_LOWER_UNITS)]
    left_eye = _regional(np.stack([units[n] for n in left]) * masks[0][:, None], rng)
    lower_face = _regional(np.stack([units[n] for n in lower]) * masks[2][:, None], rng)
    return {
        "left_eye_region": left_eye,
        "right_eye_region": region_masks.mirrored(left_eye, made.mirror),
        "lower_face_region": lower_face,
        **_tongue_basis(made, rng),
        "pupils": _pupils(made),
    }


def _regional(units: Float[np.ndarray, "U V 3"], rng: np.random.Generator) -> Float[np.ndarray, "K V 3"]:
    """Uncentred PCA of random mixtures of a few units, each between 0 and 1."""
    active = rng.uniform(size=(EXPRESSION_SAMPLES, len(units))) < min(1.0, 3 / len(units))
    mixtures = active * rng.uniform(size=active.shape)
    # The samples' span is the units': one QR instead of a Gram matrix over all vertices.
    q, r = np.linalg.qr(units.reshape(len(units), -1).T)
    components, _ = dense_components(mixtures @ r.T, EXPRESSION_SHARE, centred=False)
    return np.asarray((components @ q.T).reshape(len(components), *units.shape[1:]))


def _tongue_basis(made: Anatomy, rng: np.random.Generator) -> dict[str, Float[np.ndarray, "K V 3"]]:
    """The mean motion, then centred components: with zero coefficients the tongue rests in the mouth."""
    rows = made.slices["tongue"]
    out = made.tongue_motion(made.source.target("faceunits/tongueOut"))[rows]
    samples = tongue.motions(made.template[rows], out, TONGUE_SAMPLES, rng).reshape(TONGUE_SAMPLES, -1)
    # As people's tongues go both ways, so must the basis: each sample comes with its mirror image.
    samples = np.concatenate([samples, _mirrored_tongue(made, samples)])
    components, _ = dense_components(samples, TONGUE_SHARE, centred=True)
    found = {}
    for name, values in (("tongue_mean", samples.mean(0, keepdims=True)), ("tongue", components)):
        found[name] = np.zeros((len(values), *made.template.shape))
        found[name][:, rows] = values.reshape(len(values), -1, 3)
    return found


def _mirrored_tongue(made: Anatomy, samples: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N D"]:
    mirror = made.parts["tongue"].mirror
    return region_masks.mirrored(samples.reshape(len(samples), -1, 3), mirror).reshape(len(samples), -1)


def _pupils(made: Anatomy) -> Float[np.ndarray, "1 V 3"]:
    basis = np.zeros((1, *made.template.shape))
    for name in ("left_eye", "right_eye"):
        basis[0, made.slices[name]] = eyes.pupil_displacement(eyes.eyeball())
    return basis


def _masks(made: Anatomy) -> Float[np.ndarray, "3 V"]:
    """The regions' soft masks; all but the skin moves with the lower face."""
    part = made.parts["skin"]
    masks = np.zeros((3, len(made.template)))
    masks[2] = 1
    masks[:, made.slices["skin"]] = region_masks.soft_masks(part.vertices, made.skin.edges, part.mirror, part.groups)
    return masks


def _groups(made: Anatomy, masks: Float[np.ndarray, "3 V"]) -> dict[str, Float[np.ndarray, "V"]]:
    """All official vertex groups."""
    groups = {name: np.zeros(len(made.template)) for name in GROUPS}
    for component, part in made.parts.items():
        for name, members in part.groups.items():
            groups[name][made.slices[component]] = np.maximum(groups[name][made.slices[component]], members)
    middle = made.mirror == np.arange(len(made.template))
    groups["left"] = ((made.template[:, 0] > 0) | middle).astype(float)
    groups["right"] = groups["left"][made.mirror]
    for name in ("left_eye", "right_eye"):
        groups["eyes"][made.slices[name]] = 1
        groups["left"][made.slices[name]] = name == "left_eye"
        groups["right"][made.slices[name]] = name == "right_eye"
    skin = made.slices["skin"]
    names = ("expression_basis_left_eye", "expression_basis_right_eye", "expression_basis_mouth_nose_ears")
    for name, mask in zip(names, masks, strict=True):
        groups[name][skin] = mask[skin]
    return groups


def _skinning(made: Anatomy) -> Float[np.ndarray, "J V"]:
    weights = np.zeros((len(JOINTS), len(made.template)))
    weights[1] = 1
    skin = made.slices["skin"]
    weights[1, skin] = joints.head_weight(made.template[skin])
    for joint, name in ((2, "left_eye"), (3, "right_eye")):
        weights[:, made.slices[name]] = 0
        weights[joint, made.slices[name]] = 1
    weights[0] = 1 - weights.sum(0)
    return weights


def _joint_regressor(
    made: Anatomy, identity: Float[np.ndarray, "K V 3"], joint_identity: Float[np.ndarray, "K J 3"]
) -> Float[np.ndarray, "J V"]:
    """Sparse and mirror-symmetric: skin around the neck for neck and head, the ball's own vertices for each eye."""
    shapes = np.concatenate([made.template[None], identity])
    places = np.concatenate([made.joints[None], joint_identity])
    skin = made.parts["skin"]
    found = np.zeros((len(JOINTS), len(made.template)))
    for joint, height in enumerate(made.joints[:2, 1]):
        ring = skin.groups["skin_exterior"] & ~skin.groups["ears"] & (np.abs(skin.vertices[:, 1] - height) < 0.012)
        candidates = np.flatnonzero(ring & (skin.vertices[:, 0] >= -1e-9))[::3]
        pair = np.unique(np.concatenate([candidates, skin.mirror[candidates]]))
        weights = joints.regressor(pair, shapes, places[:, joint])
        found[joint] = (weights + weights[made.mirror]) / 2
    rows = made.slices["left_eye"]
    ball = np.arange(rows.start, rows.stop)
    found[2] = joints.regressor(ball, shapes[:1], places[:1, 2])
    found[3] = found[2][made.mirror]
    return found


def _names(basis: dict[str, Float[np.ndarray, "K V 3"]]) -> np.ndarray:
    """`head_000`, `tongue_mean`: the region's name, numbered unless it says that it is one."""
    return np.array(
        [name if name == "tongue_mean" else f"{name}_{k:03d}" for name, part in basis.items() for k in range(len(part))]
    )
