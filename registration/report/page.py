"""The HTML page of one registration: self-contained, no external resources."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup

from registration.evaluate.names import RESIDUALS
from registration.evaluate.residuals import residual_rows
from registration.frames import linear_to_srgb
from registration.report.heat_map import distance_paint, plain_paint, render_painted, scale_limit_mm, texture_paint
from registration.report.inputs import HeatMap, PictureSection, ReportInputs, distance_heat_map
from registration.report.loss_curves import loss_curves
from registration.report.pictures import CLASS_COLOURS, RgbImage, ViewImages, data_uri, view_images
from registration.report.summary import figure_parts, format_duration
from registration.report.templates import environment
from registration.report.viewer import mesh_viewer, vertex_colours
from registration.storage.hashing import to_jsonable
from registration.types import METRIC_TITLES, Registration

_OPEN_VIEWS = 4  # whose normals and classes are unfolded at first
_THUMBNAIL_QUALITY = 75  # of their JPEGs
_MAX_LIMIT_MM = 2.0  # at the end of the colour scale
_TEXTURE_PX = 512  # of the atlas' picture


def render_report(inputs: ReportInputs) -> str:
    """Return the HTML page of a registration; sections without content are omitted.

    Args:
        inputs: all contents. Text from captures and manifests is escaped.
    """
    registration = inputs.registration
    longest_s = max(registration.seconds.values(), default=0.0) or 1.0
    by_view = registration.figures.get("residuals", {}).get("views", {})
    template = environment().get_template("report.html")
    return template.render(
        subject=inputs.subject,
        expression=inputs.expression,
        parts_of_figures=figure_parts(registration),
        picture_sections=[picture_section(section) for section in inputs.sections],
        measured=any(key in registration.figures for key in METRIC_TITLES),
        **_mesh(registration, inputs.heat_map),
        residual_rows=_residual_rows(registration.figures.get("residuals", {})),
        views=[_view(view_images(view), by_view.get(view.name, {})) for view in inputs.views],
        thumbnails=[
            _view(view_images(view), by_view.get(view.name, {}), _THUMBNAIL_QUALITY) for view in inputs.thumbnails
        ],
        open_views=_OPEN_VIEWS,
        made="" if inputs.made is None else f"data:image/jpeg;base64,{base64.b64encode(inputs.made).decode()}",
        made_channels=", ".join(registration.figures.get("made", {}).get("channels", [])),
        legend=[(name, CLASS_COLOURS[k % len(CLASS_COLOURS)]) for k, name in enumerate(inputs.class_names)],
        cameras=_camera_rows(registration.figures.get("cameras", {})),
        camera_sigma_px=registration.figures.get("cameras", {}).get("sigma_px", 0.0),
        curves=Markup(loss_curves(registration.history)),
        times=[
            (stage, 100 * value / longest_s, format_duration(value)) for stage, value in registration.seconds.items()
        ],
        command=registration.provenance.get("command", ""),
        paths={name: path for name, path in registration.provenance.items() if name != "command"},
        files=inputs.files,
        config=json.dumps(to_jsonable(registration.config), indent=2) if registration.config else "",
        inputs=registration.inputs,
        versions=inputs.versions,
    )


def picture_section(section: PictureSection) -> dict[str, Any]:
    """Return a section's contents for the macro `picture_sections` of parts.html."""
    return {
        "title": section.title,
        "text": section.text,
        "pictures": [(caption, data_uri(image)) for caption, image in section.pictures],
        "svg": Markup(section.svg),
        "limit_mm": section.limit_mm,
    }


def _mesh(registration: Registration, heat: HeatMap | None) -> dict[str, Any]:
    """The mesh from three sides, in 3D, and its texture; nothing if it is not finite."""
    limit_mm = _limit_mm(registration.figures, heat) if heat else 0.0
    if not np.isfinite(registration.vertices).all():
        return {"limit_mm": limit_mm, "sides": {}, "viewer": None, "texture": ""}
    mesh = heat or distance_heat_map(registration, np.full(len(registration.vertices), np.nan))
    paints = {"texture": texture_paint(registration.corner_uvs, registration.texture), "plain": plain_paint}
    if heat:
        paints["distance"] = distance_paint(heat, limit_mm)
    sides = {
        paint: [(side, data_uri(image)) for side, image in images]
        for paint, images in render_painted(mesh, paints).items()
    }
    viewer = mesh_viewer(mesh, vertex_colours(registration, mesh, limit_mm))
    return {"limit_mm": limit_mm, "sides": sides, "viewer": viewer, "texture": data_uri(_atlas(registration.texture))}


def _limit_mm(figures: Mapping[str, Any], heat: HeatMap) -> float:
    """The end of the colour scale: by the face, not by shoulders, and so that a millimetre never looks good."""
    face = figures.get("mesh_to_scan", {}).get("face", {}).get("p95_mm")
    return min(_MAX_LIMIT_MM, scale_limit_mm(heat.distance_mm if face is None else np.array([face])))


def _atlas(texture: np.ndarray) -> RgbImage:
    """The texture's picture."""
    size = min(_TEXTURE_PX, len(texture))
    small = cv2.resize(texture.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    return (255 * linear_to_srgb(small) + 0.5).astype(np.uint8)


def _view(images: ViewImages, residuals: Mapping[str, float], quality: int = 86) -> dict[str, Any]:
    """A view's pictures and its residuals as text."""
    rows = {
        row: [(caption, data_uri(image, quality)) for caption, image in captioned]
        for row, captioned in images.rows.items()
    }
    numbers = {kind.title: kind.text(residuals[name]) for name, kind in RESIDUALS.items() if name in residuals}
    return {"name": images.name, "numbers": numbers, "rows": rows}


def _residual_rows(figure: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Kind, overall value, worst value, its view, and the meaning, as text."""
    return [
        (kind.title, "–" if overall is None else kind.text(overall), kind.text(worst), view, kind.meaning)
        for kind, overall, worst, view in residual_rows(figure)
    ]


def _camera_rows(figure: Mapping[str, Any]) -> list[tuple[str, float, str]]:
    """View, length of its bar in percent, and its correction as text, the largest first."""
    views = figure.get("views", {})
    largest = max((row["shift_px"] for row in views.values()), default=0.0) or 1.0
    return [
        (name, 100 * row["shift_px"] / largest, f"{row['shift_px']:.2f} px, {row['sigmas']:.1f} sigma")
        for name, row in sorted(views.items(), key=lambda item: -item[1]["shift_px"])
    ]
