"""A fitted moment as a registration folder, with its cameras, uncertainties, pictures and page."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from registration.capture.colmap import write_model
from registration.evaluate.audit import audit_penetration
from registration.evaluate.verdict import judge
from registration.evaluate.viewpoint import intersection_figures
from registration.footage.drawing import around, marked, shaded_over, undistorted
from registration.footage.observed import Footage
from registration.footage.uncertainty import Uncertainty, uncertainty_of
from registration.geometry.rasterizer import visible
from registration.landmark_fit.result import LandmarkFit
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.report.heat_map import render_heat_map, scale_limit_mm
from registration.report.inputs import PictureSection, ReportInputs, distance_heat_map
from registration.report.page import render_report
from registration.report.pictures import jpeg
from registration.storage import hashing
from registration.storage.registration_folder import FILES, FIT_FILES, REPORT, save_registration
from registration.types import Camera, Registration

_HEAD_PX = 512  # height of the head that residuals refer to
_SHOWN = 12  # views in pictures
_SIDE_PX = 720  # of a picture of one view
_GREY = 0.35  # linear, of the texture: images are not compared
_AGREEMENT_MM = 1.0  # standard deviation of a vertex at which its confidence is half of a certain one's
Pixels = UInt8[np.ndarray, "_ _ 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedMoment:
    """One moment, fitted."""

    footage: Footage
    fit: LandmarkFit
    data: GNMData
    schemes: Mapping[str, LandmarkScheme]  # whose landmarks on the mesh are stored
    config: Mapping[str, Any]
    digests: Mapping[str, str]
    provenance: Mapping[str, str]

    def camera(self, view: int) -> Camera:
        """The camera of a view's picture: the given one, or the fit's."""
        return self.footage.sights[view].camera or self.fit.cameras[view]


def write_moment(moment: FittedMoment, out: Path) -> Registration:
    """Write the registration folder of a fitted moment.

    Besides the files of any registration it holds `overlay.jpg`, `uncertainty.npz`, `uncertainty.png` and, as a COLMAP
    model in `sparse`, the cameras.

    Raises:
        InputError: the folder is not ours to replace.
    """
    uncertainty = uncertainty_of(moment.fit, moment.data)
    registration = _registration(moment, uncertainty)
    pictures = _pictures(moment, registration)
    heat = distance_heat_map(registration, uncertainty.total_mm)
    limit_mm = scale_limit_mm(uncertainty.total_mm[uncertainty.face])
    sides = render_heat_map(heat, limit_mm)
    views = len(moment.footage.sights)
    sections = (
        PictureSection(
            title="Fit",
            text="The mesh over each image, and the landmarks: yellow where they are in the image, red lines to where "
            "the mesh has them.",
            pictures=tuple(picture for pair in pictures for picture in pair),
        ),
        PictureSection(
            title="Uncertainty",
            text=f"Standard deviation of each vertex, given the landmarks: {uncertainty.sentence(views)}. It holds for "
            "heads that the model can have, and does not include what the landmarks' map has wrong.",
            pictures=tuple(sides),
            limit_mm=limit_mm,
        ),
    )
    page = render_report(
        ReportInputs(
            registration=registration,
            subject=moment.footage.subject,
            expression=moment.footage.expression,
            sections=sections,
            versions=hashing.versions(),
            files={name: text for name, text in {**FILES, **FIT_FILES}.items() if name != REPORT},
        )
    )
    overlay = _side_by_side([pair[0][1] for pair in pictures])
    save_registration(
        registration,
        out,
        page,
        partial(_write_cameras, moment),
        _writer(moment.fit, uncertainty, overlay, _side_by_side([image for _, image in sides])),
    )
    return registration


def _writer(fit: LandmarkFit, uncertainty: Uncertainty, overlay: Pixels, heat: Pixels) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        import cv2

        (folder / "overlay.jpg").write_bytes(jpeg(overlay, 92))
        cv2.imwrite(str(folder / "uncertainty.png"), heat[..., ::-1])
        np.savez(
            folder / "uncertainty.npz",
            vertex_sigma_mm=uncertainty.vertex_sigma_mm.astype(np.float32),
            identity_covariance=fit.identity_covariance.astype(np.float32),
            expression_sigma=fit.expression_sigma[0].astype(np.float32),
            focal_px=np.array([camera.intrinsics[0, 0] for camera in fit.cameras]),
            focal_sigma_px=fit.focal_sigma_px,
        )

    return write


def _write_cameras(moment: FittedMoment, folder: Path) -> None:
    cameras = {
        sight.image: camera if sight.camera is None else replace(sight.camera, distortion=())
        for sight, camera in zip(moment.footage.sights, moment.fit.cameras, strict=True)
    }
    write_model(folder, cameras, np.zeros((0, 3)))


def _registration(moment: FittedMoment, uncertainty: Uncertainty) -> Registration:
    fit, data = moment.fit, moment.data
    vertices = fit.vertices(data)
    offsets = np.zeros_like(vertices) if fit.options.offsets is None else fit.options.offsets
    figures = _figures(moment, vertices, uncertainty)
    return Registration(
        status=fit.status,
        reason=fit.reason,
        identity=fit.identity.astype(np.float32),
        expression=fit.expression[0].astype(np.float32),
        rotations=fit.rotations[0].astype(np.float32),
        translation=fit.translation[0],
        scale=np.array(fit.scale, np.float32),
        offsets=offsets.astype(np.float32),
        vertices=vertices,
        triangles=data.triangles,
        confidence=_confidence(moment, vertices, uncertainty),
        texture=np.full((64, 64, 3), _GREY, np.float32),
        corner_uvs=texture_atlas(data),
        landmarks={name: scheme.points(vertices) for name, scheme in moment.schemes.items()},
        seconds={"landmark fit": fit.seconds},
        history={},
        figures=figures,
        config=moment.config,
        inputs=moment.digests,
        provenance=moment.provenance,
    )


def _figures(moment: FittedMoment, vertices: Float[np.ndarray, "V 3"], uncertainty: Uncertainty) -> dict[str, Any]:
    fit, footage = moment.fit, moment.footage
    names = [sight.name for sight in footage.sights]
    cameras = {name: moment.camera(k) for k, name in enumerate(names)}
    length = np.linalg.norm(fit.residual_px[0], axis=-1)
    heights = [float(np.ptp(camera.project(vertices)[0][:, 1])) for camera in cameras.values()]
    relative = length * (_HEAD_PX / np.array(heights))[:, None]
    audit = audit_penetration(vertices, moment.data, scale=fit.scale)
    estimated = [k for k, view in enumerate(footage.observations.views) if view.focal_px is None]
    focal = [float(camera.intrinsics[0, 0]) for camera in cameras.values()]
    figures: dict[str, Any] = {
        "subject": footage.subject,
        "expression": footage.expression,
        "landmark_residual_px": {footage.observations.scheme.name: float(np.nanmedian(relative))},
        "notes": [*footage.notes, *_focal_note(footage, fit, focal, estimated), uncertainty.sentence(len(names))],
        "landmark_fit": {
            "input": footage.kind,
            "landmarks": int(footage.observations.seen.sum()),
            "rms_px": float(fit.rms_px[0]),
            "focal_px": dict(zip(names, focal, strict=True)),
            "focal_sigma_px": dict(zip(names, fit.focal_sigma_px.tolist(), strict=True)),
            "focal_source": footage.focal_source,
            "nose_depth_sigma_mm": uncertainty.nose_depth_mm,
            "face_sigma_mm": uncertainty.face_median_mm,
        },
        "residuals": {
            "overall": {"landmarks_px": float(np.nanmedian(relative))},
            "views": {name: {"landmarks_px": float(np.nanmedian(relative[k]))} for k, name in enumerate(names)},
        },
        "intersections": intersection_figures(audit, vertices, cameras),
        "unmeasured": {"scan_to_mesh": "gnmreg evaluate measures it, for a capture that has a scan"},
    }
    return {**figures, "verdict": judge(fit.status, figures).figure}


def _focal_note(footage: Footage, fit: LandmarkFit, focal: list[float], estimated: list[int]) -> list[str]:
    if not estimated:
        return [f"focal length {footage.focal_source}: {focal[0]:.0f} px" + (" and others" if len(focal) > 1 else "")]
    k = estimated[0]
    spread = f" \N{PLUS-MINUS SIGN}{fit.focal_sigma_px[k]:.0f}" if np.isfinite(fit.focal_sigma_px[k]) else ""
    return [f"focal length {footage.focal_source}: {focal[k]:.0f}{spread} px"]


def _confidence(
    moment: FittedMoment, vertices: Float[np.ndarray, "V 3"], uncertainty: Uncertainty
) -> Float[np.ndarray, "V"]:
    """s / (1 + s): s sums the cosine of incidence over the views that see a vertex, less where it is uncertain."""
    import torch

    from registration.geometry.topology import vertex_normals

    triangles = moment.data.triangles
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles.astype(np.int64))).numpy()
    total = np.zeros(len(vertices))
    for view in range(len(moment.footage.sights)):
        camera = moment.camera(view)
        ray = camera.centre - vertices
        cosine = (normals * ray).sum(1) / (np.linalg.norm(ray, axis=1) + 1e-12)
        total += np.where(visible(vertices, vertices, triangles, camera), np.clip(cosine, 0, 1), 0)
    total /= 1 + (uncertainty.total_mm / _AGREEMENT_MM) ** 2
    return (total / (1 + total)).astype(np.float32)


def _pictures(moment: FittedMoment, registration: Registration) -> list[tuple[tuple[str, Pixels], tuple[str, Pixels]]]:
    """The mesh over each view, and its landmarks."""
    result = []
    observations, fit = moment.footage.observations, moment.fit
    for k, sight in enumerate(moment.footage.sights[:_SHOWN]):
        pixels, camera = undistorted(sight.pixels(), moment.camera(k))
        fitted, _ = camera.project(observations.scheme.points(registration.vertices))
        observed = fitted - fit.residual_px[0, k]
        window = around(camera.project(registration.vertices)[0], _SIDE_PX)
        part = window.cut(pixels)
        over = shaded_over(part, registration.vertices, registration.triangles, window.camera(camera))
        rms = float(np.sqrt(np.nanmean((fit.residual_px[0, k] ** 2).sum(-1))))
        result.append(
            (
                (f"{sight.name}: the mesh", over),
                (f"{sight.name}: landmarks, {rms:.1f} px off (rms)", marked(pixels, observed, fitted, window)),
            )
        )
    return result


def _side_by_side(images: list[Pixels]) -> Pixels:
    """Images in rows of at most three."""
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    columns = min(3, len(images))
    rows = -(-len(images) // columns)
    page = np.full((rows * height, columns * width, 3), 246, np.uint8)
    for k, image in enumerate(images):
        top, left = k // columns * height, k % columns * width
        page[top : top + image.shape[0], left : left + image.shape[1]] = image
    return page
