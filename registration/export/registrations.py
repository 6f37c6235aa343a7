"""Heads to export, from registrations and a model."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from registration.errors import InputError
from registration.export.arkit import NAMES, arkit_shapes
from registration.export.fill import fill_unseen
from registration.export.head_mesh import HeadMesh, Topology
from registration.export.options import ExportOptions
from registration.frames import linear_to_srgb, transform_points
from registration.geometry.rigid import align
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.types import Registration

_WEAKEST = 5  # shapes that are printed


def head_of_model(data: GNMData, *, name: str, shapes: Mapping[str, Float[np.ndarray, "V 3"]]) -> HeadMesh:
    """Return a model's template, without a texture.

    Args:
        data: the model.
        name: of the mesh in the file.
        shapes: name -> displacement of the template, metres.
    """
    return HeadMesh(
        name=name,
        vertices=data.template_vertex_positions.astype(np.float64),
        topology=Topology.from_model(data),
        shapes=shapes,
        origin={"frame": "head"},
    )


def head_of_registration(
    registration: Registration,
    data: GNMData,
    *,
    name: str,
    options: ExportOptions = ExportOptions(),  # noqa: B008  frozen
) -> HeadMesh:
    """Return the mesh of one registration.

    Args:
        registration: of this model's topology.
        data: the model, for quads, materials and the head's frame.
        name: of the mesh in the file.
        options: of the export.

    Raises:
        InputError: it failed, or has another topology.
    """
    check_usable(registration, name, options)
    topology = Topology.from_model(data, registration.corner_uvs)
    topology.check(registration.triangles, name)
    vertices = registration.vertices.astype(np.float64)
    return HeadMesh(
        name=name,
        vertices=transform_points(T_out_world(vertices, data, options), vertices),
        topology=topology,
        texture=srgb_bytes(registration.texture),
        origin={"frame": options.frame, "status": registration.status},
    )


def with_filled_texture(
    head: HeadMesh,
    registration: Registration,
    mirror: Int[np.ndarray, "V"],
    others: Sequence[tuple[str, Registration]] = (),
) -> tuple[HeadMesh, list[str]]:
    """Return a head with the texels filled that no camera saw, and notes for people.

    Args:
        head: of the registration.
        registration: whose texture and confidence count.
        mirror: of the model.
        others: name and registration of others of the subject, the preferred first.

    Raises:
        InputError: another one has another topology, or another atlas.
    """
    for name, other in others:
        head.topology.check(other.triangles, name)
        if not np.array_equal(other.corner_uvs, registration.corner_uvs):
            raise InputError(
                "A registration has another texture atlas",
                where=name,
                expected="the uvs of the one that is filled",
                got="others",
                fix="register both with one model and one release of this program",
            )
    filled = fill_unseen(registration, head.topology, mirror, [other for _, other in others])
    origins = [*(name for name, _ in others), "the other side", "their surroundings", "nothing: their colours are kept"]
    shares = [
        f"{100 * share:.1f} % {name}" for name, share in zip(origins, filled.shares.values(), strict=True) if share
    ]
    note = f"texels that no camera saw are filled from: {', '.join(shares)}" if shares else "cameras saw every texel"
    return replace(head, texture=srgb_bytes(filled.texture), unseen=filled.unseen), [note]


def with_arkit(head: HeadMesh, data: GNMData, options: ExportOptions, scale: float = 1.0) -> tuple[HeadMesh, list[str]]:
    """Return a head with ARKit's shapes instead of others, and notes for people.

    Args:
        head: without expression, in the frame of the options.
        data: its model.
        options: of the export.
        scale: of the registration, by which the model's expressions are scaled too.

    Raises:
        InputError: as `arkit_shapes`.
    """
    T_head_out = T_out_world(head.vertices, data, replace(options, frame="head"))
    solved = arkit_shapes(data, transform_points(T_head_out, head.vertices) / scale)
    shapes = {name: scale * moves @ T_head_out[:3, :3] for name, moves in solved.displacements.items()}
    figures = {
        name: {"coverage": round(shape.coverage, 4), "residual_mm": round(shape.residual_mm, 4)}
        for name, shape in solved.shapes.items()
    }
    notes = [f"{len(shapes)} of ARKit's {len(NAMES)} shapes; share of the motion that the model's basis makes:"]
    weakest = sorted(solved.shapes, key=lambda name: solved.shapes[name].coverage)[:_WEAKEST]
    notes += [f"  {name}: {solved.shapes[name].coverage:.2f}" for name in weakest]
    notes += [f"not in the model's basis, left out: {name} ({s.coverage:.2f})" for name, s in solved.missing.items()]
    return replace(head, shapes=shapes, shape_figures=figures), notes


def with_expressions(
    neutral: HeadMesh,
    vertices: Iterable[tuple[str, Float[np.ndarray, "V 3"]]],
    T_out_world: Float[np.ndarray, "4 4"],
    options: ExportOptions,
) -> HeadMesh:
    """Return a neutral with a subject's expressions as shapes, or as frames if the options ask for a sequence.

    Args:
        neutral: the head at rest, in the exported frame.
        vertices: name and vertices of each expression, metres, in the neutral's world, without motion of the head.
        T_out_world: from the neutral's world to the exported frame.
        options: of the export.
    """
    posed = {name: transform_points(T_out_world, points.astype(np.float64)) for name, points in vertices}
    if options.sequence:
        return with_frames(neutral, list(posed.values()), options)
    return replace(neutral, shapes={name: points - neutral.vertices for name, points in posed.items()})


def with_frames(head: HeadMesh, frames: list[Float[np.ndarray, "V 3"]], options: ExportOptions) -> HeadMesh:
    """Return a head that moves: vertices of each frame in the exported frame; the first are those at rest."""
    stacked = np.stack(frames).astype(np.float32)
    return replace(
        head, vertices=stacked[0].astype(np.float64), frames=stacked, shapes={}, frames_per_second=options.fps
    )


def check_usable(registration: Registration, where: object, options: ExportOptions) -> None:
    """Refuse a failed registration, and always one whose vertices are not finite. Raises InputError."""
    finite = bool(np.isfinite(registration.vertices).all())
    if (registration.status == "failed" and options.failed != "export") or not finite:
        raise InputError(
            "A registration failed",
            where=where,
            expected="converged or stopped",
            got=registration.reason if finite else f"{registration.reason}; vertices that are not finite",
            fix="register it again" + (", or export it all the same with --failed export" if finite else ""),
        )


def T_out_world(vertices: Float[np.ndarray, "V 3"], data: GNMData, options: ExportOptions) -> Float[np.ndarray, "4 4"]:
    """Return the rigid motion into the frame that is exported.

    Args:
        vertices: of a head, metres, its world.
        data: the model.
        options: of the export.

    Returns:
        For the frame "head" the alignment with the model's template by the skin on the skull, without scale; else the
        identity.
    """
    if options.frame == "world":
        return np.eye(4)
    template = data.template_vertex_positions.astype(np.float64)
    weights = vertex_areas(template, data.triangles) * regions.skull_skin(data)
    return align(vertices[None].astype(np.float64), template, weights[None])[0]


def srgb_bytes(texture: Float[np.ndarray, "R R 3"]) -> UInt8[np.ndarray, "R R 3"]:
    """Return a linear texture as 8 bit sRGB; texels that are not finite are black."""
    finite = np.nan_to_num(np.asarray(texture, np.float64))
    return np.asarray(np.round(255 * linear_to_srgb(finite)), np.uint8)
