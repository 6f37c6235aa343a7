"""The page of a fitted sequence: video, stills, curves, uncertainty, provenance."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from registration.footage.curves import curves_of
from registration.footage.observed import Footage
from registration.footage.uncertainty import Uncertainty
from registration.frames import axis_angle_to_matrix
from registration.landmark_fit.result import LandmarkFit
from registration.model.gnm_npz import GNMData
from registration.report.charts import ChartLine, line_charts
from registration.report.heat_map import render_heat_map, scale_limit_mm
from registration.report.inputs import HeatMap, PictureSection
from registration.report.page import picture_section
from registration.report.summary import format_duration
from registration.report.templates import environment


@dataclass(frozen=True, kw_only=True, eq=False)
class PageInputs:
    """All contents of the page."""

    footage: Footage
    fit: LandmarkFit
    data: GNMData
    uncertainty: Uncertainty
    opening_mm: Float[np.ndarray, "F"] | None  # of the mouth
    stills: Sequence[tuple[str, UInt8[np.ndarray, "_ _ 3"]]]
    manifest: Mapping[str, Any]
    files: Mapping[str, str]
    video: str  # name of its file; "": there is none


def render_page(inputs: PageInputs) -> str:
    """Return the HTML page of a fitted sequence; the video is a file beside it."""
    figures = inputs.manifest["figures"]
    spread = f"\N{PLUS-MINUS SIGN}{figures['focal_sigma_px']:.0f}" if figures["focal_sigma_px"] else "given"
    tiles = [
        (str(figures["frames"]), "", "frames with the face"),
        (f"{figures['rms_px']:.2f}", "px", "distance of the landmarks, rms"),
        (f"{figures['focal_px']:.0f}", "px", f"focal length, {spread}"),
        (f"\N{PLUS-MINUS SIGN}{figures['nose_depth_sigma_mm']:.1f}", "mm", "depth of the nose, one standard deviation"),
        (format_duration(figures["seconds"]), "", "to solve"),
    ]
    sections = [_stills(inputs), _curves(inputs), _uncertainty(inputs)]
    return (
        environment("registration.footage")
        .get_template("sequence.html")
        .render(
            subject=inputs.footage.subject,
            status=inputs.manifest["status"],
            reason=inputs.manifest["reason"],
            notes=figures["notes"],
            tiles=tiles,
            video=inputs.video,
            sections=[picture_section(section) for section in sections],
            files=inputs.files,
            command=inputs.manifest["provenance"].get("command", ""),
            config=json.dumps(inputs.manifest["config"], indent=2),
            inputs=inputs.manifest["inputs"],
            versions=inputs.manifest["versions"],
        )
    )


def _stills(inputs: PageInputs) -> PictureSection:
    text = "The mesh over frames that are spread over the video."
    return PictureSection(title="Frames", text=text, pictures=tuple(inputs.stills))


def _curves(inputs: PageInputs) -> PictureSection:
    curves, times = curves_of(inputs.fit, inputs.data), inputs.footage.times_s.tolist()

    def line(name: str, values: Float[np.ndarray, "F"]) -> ChartLine:
        return ChartLine(name=name, x=times, y=values.tolist())

    zero = {"Residual, px": [line("landmarks, rms", curves.rms_px)]}
    if inputs.opening_mm is not None:
        zero["Opening of the mouth, mm"] = [line("inner lips", inputs.opening_mm)]
    turns = {
        "Rotation of the head, degrees": [
            line(name, curves.rotation_deg[:, k]) for k, name in enumerate(("yaw", "pitch", "roll"))
        ],
        "Distance from the camera, mm": [line("distance", curves.distance_mm)],
    }
    svg = line_charts(zero, "seconds") + line_charts(turns, "seconds", from_zero=False)
    text = "Yaw, pitch and roll are zero where the face looks into the camera. The focal length is one for all frames."
    return PictureSection(title="Curves", text=text, svg=svg)


def _uncertainty(inputs: PageInputs) -> PictureSection:
    uncertainty = inputs.uncertainty
    T_head_world = np.eye(4)
    T_head_world[:3, :3] = axis_angle_to_matrix(torch.from_numpy(inputs.fit.rotations[0, 0].astype(np.float64))).T
    heat = HeatMap(
        vertices=inputs.fit.vertices(inputs.data, 0),
        triangles=inputs.data.triangles,
        distance_mm=uncertainty.total_mm,
        T_head_world=T_head_world,
    )
    limit_mm = scale_limit_mm(uncertainty.total_mm[uncertainty.face])
    return PictureSection(
        title="Uncertainty",
        text=f"Standard deviation of each vertex in the first frame, given the landmarks: {uncertainty.sentence(1)}.",
        pictures=tuple(render_heat_map(heat, limit_mm)),
        limit_mm=limit_mm,
    )
