"""Regions of a model by *role*. Only this module knows the names of the file's vertex groups."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from registration.errors import InputError
from registration.model.gnm_npz import GNMData

CLASSES = ("skin", "left_eye", "right_eye", "upper_lip", "lower_lip", "ears", "mouth_interior")
# Every class but `skin`, which is the rest.
_SOURCES = {
    "left_eye": ("left_eye",),
    "right_eye": ("right_eye",),
    "upper_lip": ("upper_lip",),
    "lower_lip": ("lower_lip",),
    "ears": ("ears",),
    "mouth_interior": ("mouth_sock", "teeth", "gums", "tongue"),
}
_INSIDE = 0.5  # a weight above this counts as membership where a yes or no is needed


def group(data: GNMData, name: str) -> Float[np.ndarray, "V"]:
    """Return the weights of one vertex group, float32. Raises InputError, which lists the groups, if it is missing."""
    names = data.vertex_group_names.tolist()
    if name not in names:
        raise InputError(
            f"The model has no vertex group '{name}'",
            where="vertex_group_names",
            expected=f"a group '{name}'",
            got=", ".join(names),
            fix="use a model file that carries the official vertex groups",
        )
    return data.vertex_groups[names.index(name)].astype(np.float32)


def vertex_classes(data: GNMData) -> tuple[tuple[str, ...], Float[np.ndarray, "V K"]]:
    """Return the classes' names, in order, and each vertex' soft membership of each; rows sum to one.

    `skin` is the rest, with `neck_other` of the captures in it.
    """
    memberships = {
        label: np.max([np.clip(group(data, name), 0, 1) for name in sources], axis=0)
        for label, sources in _SOURCES.items()
    }
    shares = np.stack([memberships.get(label, np.zeros(len(data.template_vertex_positions))) for label in CLASSES], 1)
    shares[:, 0] = np.clip(1 - shares.sum(1), 0, 1)
    return CLASSES, (shares / shares.sum(1, keepdims=True)).astype(np.float32)


def neck_other(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Neck, nape and chest: skin outside the face mask and the ears, below the face mask's lowest vertex."""
    face = group(data, "hockey_mask") > _INSIDE
    height = data.template_vertex_positions[:, 1]
    skin = (group(data, "skin") > _INSIDE) & ~face & ~(group(data, "ears") > _INSIDE)
    return skin & (height < height[face].min(initial=np.inf))


def exterior(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Skin that is visible from outside, with lips and eyelid rims, and may have offsets.

    Eye sockets, the lining of nostrils and mouth, and the eyeballs, which move rigidly, are not in it.
    """
    return group(data, "skin_exterior") > _INSIDE


def components(data: GNMData) -> Int[np.ndarray, "V"]:
    """Return each vertex' index into `mesh_component_names`. Raises InputError for a vertex of no component."""
    weights = np.stack([group(data, name) for name in data.mesh_component_names.tolist()])
    missing = np.flatnonzero(weights.max(0) <= _INSIDE)
    if len(missing):
        raise InputError(
            "Some vertices belong to no mesh component",
            where="vertex_groups, mesh_component_names",
            expected="every vertex in the vertex group of one component",
            got=f"{len(missing)} vertices in none, first {missing[0]}",
            fix="use a model file whose components' vertex groups cover the mesh",
        )
    return weights.argmax(0)


_MATERIALS = {  # of the components that share one; the others' materials have the component's name
    "left_eye": "eyes",
    "right_eye": "eyes",
    "upper_teeth_and_gums": "teeth",
    "lower_teeth_and_gums": "teeth",
}


def materials(data: GNMData) -> tuple[tuple[str, ...], Int[np.ndarray, "V"]]:
    """Return the names of the materials (skin, eyes, teeth, tongue) and each vertex' index into them.

    Raises:
        InputError: a vertex is in no component.
    """
    of_component = [_MATERIALS.get(name, name) for name in data.mesh_component_names.tolist()]
    names = tuple(dict.fromkeys(of_component))
    return names, np.array([names.index(name) for name in of_component])[components(data)]


def solids(data: GNMData) -> dict[str, Int[np.ndarray, "_ 3"]]:
    """Triangles of the parts that must not intersect: skin, left eye, right eye, teeth with their gums, tongue."""
    upper, lower = "upper_teeth_and_gums", "lower_teeth_and_gums"
    roles = {"skin": ("skin",), "left eye": ("left_eye",), "right eye": ("right_eye",), "teeth": (upper, lower)}
    triangles = {}
    for role, names in (roles | {"tongue": ("tongue",)}).items():
        members = np.max([group(data, name) for name in names], axis=0) > _INSIDE
        triangles[role] = data.triangles[members[data.triangles].all(1)].astype(np.int64)
    return triangles


def crossing_parts(data: GNMData) -> Int[np.ndarray, "F"]:
    """Return each triangle's part number: intersections are searched between parts, not within one.

    Parts are the components of the mesh and both lips.
    """
    lips = [group(data, name)[data.triangles].min(1) > 0.5 for name in ("upper_lip", "lower_lip")]
    parts = components(data)[data.triangles[:, 0]]
    for number, lip in enumerate(lips):
        parts = np.where(lip, len(data.mesh_component_names) + number, parts)
    return parts


def eyeball_shells(data: GNMData) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """The outer shells of the left and the right eyeball: sclera and cornea, without iris and pupil."""
    outer = group(data, "eye_exteriors") > _INSIDE
    return outer & (group(data, "left_eye") > _INSIDE), outer & (group(data, "right_eye") > _INSIDE)


def eyeballs(data: GNMData) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """The left and the right eyeball, complete."""
    return group(data, "left_eye") > _INSIDE, group(data, "right_eye") > _INSIDE


def skin(data: GNMData) -> Bool[np.ndarray, "V"]:
    """All skin, with inner surfaces: all but eyeballs, teeth, gums and tongue."""
    return group(data, "skin") > _INSIDE


def lower_teeth(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Lower teeth with their gums, which move rigidly with the jaw."""
    return group(data, "lower_teeth_and_gums") > _INSIDE


def jaw_parts(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Parts other than skin that move with the jaw: lower teeth with their gums, and the tongue."""
    return lower_teeth(data) | tongue(data)


def expression_skin(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The skin of both eye regions of the expression basis, up to the middle of their blend into the lower face."""
    left, right = (group(data, f"expression_basis_{side}_eye") for side in ("left", "right"))
    return (left + right > _INSIDE) & skin(data)


def lips(data: GNMData) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """Upper and lower lip with the skin around them; they may share the corners of the mouth."""
    upper, lower = (
        (group(data, name) > _INSIDE) | (group(data, f"{name}_region") > _INSIDE) for name in ("upper_lip", "lower_lip")
    )
    return upper, lower


def ears(data: GNMData) -> Bool[np.ndarray, "V"]:
    return group(data, "ears") > _INSIDE


def teeth(data: GNMData) -> Bool[np.ndarray, "V"]:
    """All teeth, without the gums' own vertices."""
    return group(data, "teeth") > _INSIDE


def tongue(data: GNMData) -> Bool[np.ndarray, "V"]:
    return group(data, "tongue") > _INSIDE


def palate(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The upper gums and the roof of the mouth, as far as the model has one."""
    return gums(data)[0]


def gums(data: GNMData) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """Upper and lower gums, each without its teeth."""
    gums = group(data, "gums") > _INSIDE
    upper = group(data, "upper_teeth_and_gums") > _INSIDE
    return gums & upper, gums & ~upper


def mouth_lining(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The inside of lips and cheeks: skin that is not exterior. Empty in a model without oral cavity."""
    return group(data, "mouth_sock") > _INSIDE


def lids(data: GNMData) -> Float[np.ndarray, "V"]:
    """The skin that slides and folds over the eyeballs: 1 within 3 mm of them, 0 beyond 9 mm."""
    return np.maximum(*lids_by_eye(data))


def lids_by_eye(data: GNMData) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """The lids, as `lids`, of the left and of the right eyeball."""
    left, right = (exterior(data) * _nearness(data, ball, 3e-3, 9e-3) for ball in eyeballs(data))
    return left, right


def inner_lips(data: GNMData) -> Float[np.ndarray, "V"]:
    """The part of the lips that is hidden in a closed mouth: 1 within 2 mm of the mouth's lining, 0 beyond 5 mm."""
    lips = np.clip(group(data, "upper_lip") + group(data, "lower_lip"), 0, 1)
    return lips * _nearness(data, group(data, "mouth_sock") > _INSIDE, 2e-3, 5e-3)


def blush(data: GNMData) -> Float[np.ndarray, "V"]:
    """Skin whose colour changes with expression and effort: the cheeks, up to the cheekbones and the eyes."""
    names = ("cheek", "zygomatic", "infraorbital")
    groups = [group(data, f"{side}_{name}_region") for side in ("left", "right") for name in names]
    return np.clip(np.max(groups, axis=0), 0, 1)


def inner_lip_vertices(data: GNMData) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """The inner part of the upper and of the lower lip, as `inner_lips`; vertices of both lips are in neither."""
    upper, lower = (group(data, name) > _INSIDE for name in ("upper_lip", "lower_lip"))
    inner = inner_lips(data) > _INSIDE
    return upper & ~lower & inner, lower & ~upper & inner


def lower_lip_and_chin(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The outer skin that is nearest to the jaw: lower lip and chin, without the corners of the mouth."""
    jaw = _any(data, ("lower_lip", "lower_lip_region", "chin_region"))
    return jaw & ~_any(data, ("upper_lip", "upper_lip_region")) & exterior(data)


def nostrils(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The inner surface of the nostrils: skin that is neither exterior nor in the mouth or the eye sockets."""
    other = (group(data, "mouth_sock") > _INSIDE) | (group(data, "eye_sockets") > _INSIDE)
    return (group(data, "skin") > _INSIDE) & ~exterior(data) & ~other


def outer_surface(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The exterior without ears, nostrils and hidden lips, and without the rims of mouth and lids."""
    linings = _any(data, ("mouth_sock", "eye_sockets")) & ~exterior(data)
    hidden = ears(data) | (inner_lips(data) > _INSIDE) | (_nearness(data, linings, 1e-3, 3e-3) > _INSIDE)
    return exterior(data) & ~hidden & ~nostrils(data)


def offset_regions(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """Regions of the skin for which a recipe may have settings of its own, by name."""
    lips = (group(data, "upper_lip") > _INSIDE) | (group(data, "lower_lip") > _INSIDE)
    linings = (group(data, "mouth_sock") > _INSIDE) | (group(data, "eye_sockets") > _INSIDE)
    return {
        "nostrils": nostrils(data),
        "lips": lips,
        "lids": lids(data) > _INSIDE,
        "ears": ears(data),
        "linings": linings,
    }


def skull_skin(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Skin that may be at rest on the skull: the exterior without neck and nape, which follow the body, and without
    the skin that jaw, mouth and cheeks move: lips, chin, cheeks up to the eyelids, and the skin before the ears."""
    sides = [f"{side}_{name}_region" for name in ("infraorbital", "cheek", "parotid") for side in ("left", "right")]
    moving = _any(data, (*_MOUTH, *sides))
    return exterior(data) & ~neck_other(data) & ~moving


def head_skin(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Skin on which head shape is measured: the exterior without the neck, which rotates at its own joint."""
    return exterior(data) & ~neck_other(data)


def face(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Outer skin of the face: all that its expressions move by more than a little."""
    return (group(data, "hockey_mask") > _INSIDE) & exterior(data)


def cranium(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Skin of the head around the face mask, with the ears: what hair, a cap or missing cameras may hide."""
    return head_skin(data) & (group(data, "hockey_mask") <= _INSIDE)


def head_regions(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """Regions of `head_skin` for which metrics are given; they may overlap and need not cover it."""
    parts = stabilization_regions(data)
    back = parts.pop("neck_back")
    regions = {
        "face": group(data, "hockey_mask") > _INSIDE,
        **parts,
        "forehead": group(data, "forehead_region") > _INSIDE,
        "chin": group(data, "chin_region") > _INSIDE,
        "ears": ears(data),
        "back": back,
    }
    return {name: members & head_skin(data) for name, members in regions.items()}


_CHEEK = ("cheek", "infraorbital", "zygomatic")
_COMMON_AREAS = {  # of [GNM, Generalization to Novel Shapes] -> official vertex groups
    "nose": ("nose_region",),
    "mouth": ("upper_lip", "lower_lip", "upper_lip_region", "lower_lip_region"),
    "eyes": ("left_orbital_region", "right_orbital_region"),
    "cheeks": tuple(f"{side}_{name}_region" for side in ("left", "right") for name in _CHEEK),
    "chin": ("chin_region",),
    "forehead": ("forehead_region", "middle_brow_region", "left_brow_region", "right_brow_region"),
}


def common_face(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """Return the face on which models of different topology are compared, "face", and its areas.

    Only exterior skin: no ears, eyeballs, nostrils, or inside of the mouth. The areas do not cover all of the face.
    """
    members = face(data)
    return {"face": members} | {name: _any(data, groups) & members for name, groups in _COMMON_AREAS.items()}


_FACE_AREAS = ("upper_lip", "lower_lip", "upper_lip_region", "lower_lip_region", "chin_region", "nose_region")
_LEFT_AREAS = ("brow", "cheek", "infraorbital", "zygomatic")


def face_areas(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """Areas of the exterior that the muscles of the face move: of the middle, and those on the subject's left.

    upper_lip, lower_lip, upper_lip_region, lower_lip_region, chin, nose, middle_brow; left_brow, left_cheek,
    left_infraorbital, left_zygomatic.
    """
    names = {name.removesuffix("_region") if name[:5] in ("chin_", "nose_") else name: name for name in _FACE_AREAS}
    names |= {"middle_brow": "middle_brow_region"} | {f"left_{area}": f"left_{area}_region" for area in _LEFT_AREAS}
    return {area: (group(data, name) > _INSIDE) & exterior(data) for area, name in names.items()}


def eye_sockets(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The inside of the eyelids and the sockets behind them, up to the lids' edges."""
    return (group(data, "eye_sockets") > _INSIDE) & ~exterior(data)


def expression_modes(data: GNMData) -> dict[str, Int[np.ndarray, "K"]]:
    """The indices of the expression components by what they move: the regions of the basis, and the tongue."""
    names = data.expression_names.tolist()
    modes = {region: indices for region, (indices, _) in expression_regions(data).items()}
    return modes | {"tongue": np.array([k for k, name in enumerate(names) if name.startswith("tongue")], np.int64)}


_EXPRESSION_GROUPS = {  # region of an expression component's name -> the group that holds its soft mask
    "left_eye_region": "expression_basis_left_eye",
    "right_eye_region": "expression_basis_right_eye",
    "lower_face_region": "expression_basis_mouth_nose_ears",
}


def expression_regions(data: GNMData) -> dict[str, tuple[Int[np.ndarray, "K"], Float[np.ndarray, "V"]]]:
    """Return, for each region of the expression basis, the indices of its components and its soft mask.

    Left eye, right eye, lower face; regions without a component in the file are missing.
    """
    names = data.expression_names.tolist()
    regions = {}
    for region, source in _EXPRESSION_GROUPS.items():
        members = [k for k, name in enumerate(names) if name.startswith(region)]
        if members:
            regions[region.removesuffix("_region")] = (np.array(members), np.clip(group(data, source), 0, 1))
    return regions


_MOUTH = ("upper_lip", "lower_lip", "upper_lip_region", "lower_lip_region", "chin_region")
REFERENCE_REGIONS = ("nose", "neck_back")  # of `stabilization_regions`: where expressions move the skin least


def stabilization_regions(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """The five regions in which an operator looks for motion of the whole head [GNM, Head Expression]; all exterior.

    They overlap where cheeks meet lower eyelids, and do not contain ears and forehead.
    """
    sides = [f"{side}_{name}_region" for name in ("infraorbital", "cheek") for side in ("left", "right")]
    face = ("hockey_mask", "ears", "forehead_region")
    sources = {
        "left_periocular": ("expression_basis_left_eye",),
        "right_periocular": ("expression_basis_right_eye",),
        "nose": ("nose_region",),
        "mouth": (*_MOUTH, *sides),
    }
    regions = {name: _any(data, groups) & exterior(data) for name, groups in sources.items()}
    return regions | {"neck_back": exterior(data) & ~_any(data, face)}


def _any(data: GNMData, names: tuple[str, ...]) -> Bool[np.ndarray, "V"]:
    return np.max([group(data, name) for name in names], axis=0) > _INSIDE


def _nearness(data: GNMData, members: Bool[np.ndarray, "V"], near: float, far: float) -> Float[np.ndarray, "V"]:
    """1 within `near` (metres, in the template) of the nearest member, decreasing to 0 at `far`."""
    points = data.template_vertex_positions
    if not members.any():
        return np.zeros(len(points), np.float32)
    distance = cKDTree(points[members]).query(points)[0]
    return np.clip((far - distance) / (far - near), 0, 1).astype(np.float32)
