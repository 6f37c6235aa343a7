"""Heads to export, from registrations and a model."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8

from registration.errors import InputError
from registration.export.head_mesh import HeadMesh, Topology
from registration.export.options import ExportOptions
from registration.frames import linear_to_srgb, transform_points
from registration.geometry.rigid import align
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.types import Registration


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
    check_usable(registration, name, accept_failed=options.accept_failed)
    topology = Topology.from_model(data, registration.corner_uvs)
    topology.check(registration.triangles, name)
    vertices = registration.vertices.astype(np.float64)
    if options.frame == "head":
        vertices = transform_points(T_head_world(vertices, data), vertices)
    return HeadMesh(
        name=name,
        vertices=vertices,
        topology=topology,
        texture=srgb_bytes(registration.texture),
        origin={"frame": options.frame, "status": registration.status},
    )


def check_usable(registration: Registration, where: object, *, accept_failed: bool) -> None:
    """Refuse a failed registration, and always one whose vertices are not finite. Raises InputError."""
    finite = bool(np.isfinite(registration.vertices).all())
    if (registration.status == "failed" and not accept_failed) or not finite:
        raise InputError(
            "A registration failed",
            where=where,
            expected="converged or stopped",
            got=registration.reason if finite else f"{registration.reason}; vertices that are not finite",
            fix="register it again" + (", or export it all the same with --accept-failed" if finite else ""),
        )


def T_head_world(vertices: Float[np.ndarray, "V 3"], data: GNMData) -> Float[np.ndarray, "4 4"]:
    """Align a head with the model's template by the skin on the skull; rigid, without scale.

    Args:
        vertices: metres, any world.
        data: the model.

    Returns:
        p_head = T_head_world @ p_world.
    """
    template = data.template_vertex_positions.astype(np.float64)
    weights = vertex_areas(template, data.triangles) * regions.skull_skin(data)
    return align(vertices[None].astype(np.float64), template, weights[None])[0]


def srgb_bytes(texture: Float[np.ndarray, "R R 3"]) -> UInt8[np.ndarray, "R R 3"]:
    """Return a linear texture as 8 bit sRGB; texels that are not finite are black."""
    finite = np.nan_to_num(np.asarray(texture, np.float64))
    return np.asarray(np.round(255 * linear_to_srgb(finite)), np.uint8)


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
