"""A fitted sequence as a folder: `fit.npz`, its manifest, a page, a video of the mesh over the frames, meshes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from registration.errors import InputError
from registration.footage.curves import mouth_opening_mm
from registration.footage.drawing import shaded_over, undistorted
from registration.footage.observed import Footage
from registration.footage.options import FootageOptions
from registration.footage.overlay_video import SUFFIX, VideoWriter, even_size
from registration.footage.sequence_file import FILE
from registration.footage.sequence_page import PageInputs, render_page
from registration.footage.uncertainty import Uncertainty, uncertainty_of
from registration.footage.video import Video
from registration.landmark_fit.result import LandmarkFit
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.progress import Progress
from registration.report.glb import static_glb
from registration.storage import hashing
from registration.storage.files import atomic_directory, json_text, read_json_of_kind, refuse_foreign, write_json
from registration.storage.mesh import write_obj
from registration.types import Camera

KIND, SCHEMA = "gnm-landmark-fit", 1
MANIFEST, PAGE, OVERLAY, MESHES, SIGMA = "manifest.json", "index.html", f"overlay{SUFFIX}", "meshes", "uncertainty.npz"
FILES = {
    FILE: "identity, parameters of every frame, cameras, residuals, uncertainties",
    OVERLAY: "the mesh over the frames",
    SIGMA: "standard deviation of each vertex of the first frame",
    MANIFEST: "inputs, configuration, status and figures, for programs",
    MESHES: "meshes of some frames",
}
_LONGEST_PX = 960  # longer side of the video
_STILLS = 6  # frames on the page
_CHUNK = 40  # frames whose vertices are computed at once
_SKIN = (200.0, 190.0, 180.0)  # sRGB, of GLB files
Pixels = UInt8[np.ndarray, "_ _ 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedSequence:
    """A video, fitted."""

    footage: Footage
    video: Video
    fit: LandmarkFit
    data: GNMData
    options: FootageOptions
    config: Mapping[str, Any]
    digests: Mapping[str, str]
    provenance: Mapping[str, str]


def check_sequence_folder(out: Path) -> None:
    """Refuse an output folder that is not ours to replace. Raises InputError."""
    refuse_foreign(out, kind=KIND, command="fit", manifest=MANIFEST, files=(*FILES, PAGE))


def find_sequence(out: Path, input_hash: str) -> dict[str, Any] | None:
    """Return the manifest of a fitted sequence of the same inputs, or None."""
    manifest = read_json_of_kind(out / MANIFEST, KIND)
    same = manifest is not None and manifest.get("input_hash") == input_hash and (out / FILE).is_file()
    return manifest if same else None


def check_mesh_frames(footage: Footage, options: FootageOptions) -> None:
    """Refuse numbers of frames that are not fitted. Raises InputError."""
    missing = sorted(set(options.mesh_frames() or ()) - set(footage.numbers.tolist()))
    if options.meshes is not None and missing:
        raise InputError(
            "There is no such frame",
            where="--frames",
            expected=f"frames with a face, from {footage.numbers[0]} to {footage.numbers[-1]}",
            got=", ".join(map(str, missing[:5])),
            fix="choose others, or leave --frames out for all",
        )


def write_sequence(sequence: FittedSequence, out: Path, progress: Progress) -> dict[str, Any]:
    """Write the folder of a fitted sequence in one rename. Returns its manifest.

    Raises:
        InputError: the folder is not ours to replace.
    """
    check_sequence_folder(out)
    fit, footage = sequence.fit, sequence.footage
    uncertainty = uncertainty_of(fit, sequence.data)
    manifest = _manifest(sequence, uncertainty)
    with atomic_directory(out) as temporary:
        np.savez_compressed(temporary / FILE, allow_pickle=False, **_arrays(sequence))
        np.savez_compressed(temporary / SIGMA, vertex_sigma_mm=uncertainty.vertex_sigma_mm.astype(np.float32))
        opening, stills = _draw(sequence, temporary, progress)
        write_json(temporary / MANIFEST, manifest)
        listed = {name: text for name, text in FILES.items() if (temporary / name).exists()}
        page = PageInputs(
            footage=footage,
            fit=fit,
            data=sequence.data,
            uncertainty=uncertainty,
            opening_mm=opening,
            stills=stills,
            manifest=manifest,
            files=listed,
            video=OVERLAY if sequence.options.video else "",
        )
        (temporary / PAGE).write_text(render_page(page), encoding="utf-8")
    return manifest


def _arrays(sequence: FittedSequence) -> dict[str, np.ndarray]:
    fit, footage = sequence.fit, sequence.footage
    cameras = fit.cameras
    single = {"expression", "rotations", "expression_sigma", "residual_px", "weights", "identity_covariance"}
    arrays: dict[str, Any] = {
        "identity": fit.identity,
        "expression": fit.expression,
        "rotations": fit.rotations,
        "translation": fit.translation,
        "scale": np.float64(fit.scale),
        "frames": footage.numbers,
        "times_s": footage.times_s,
        "camera_intrinsics": np.array([camera.intrinsics for camera in cameras]),
        "camera_T_cam_world": np.array([camera.T_cam_world for camera in cameras]),
        "camera_size_px": np.array([(camera.width_px, camera.height_px) for camera in cameras]),
        "camera_k1": np.array([camera.distortion[0] if camera.distortion else 0.0 for camera in cameras]),
        "focal_sigma_px": fit.focal_sigma_px,
        "residual_px": fit.residual_px,
        "weights": fit.weights,
        "identity_covariance": fit.identity_covariance,
        "expression_sigma": fit.expression_sigma,
        "status": np.array(fit.status),
        "reason": np.array(fit.reason),
        "scheme": np.array(footage.observations.scheme.name),
        "config": np.array(json_text(sequence.config)),
    }
    return {name: value.astype(np.float32) if name in single else np.asarray(value) for name, value in arrays.items()}


def _manifest(sequence: FittedSequence, uncertainty: Uncertainty) -> dict[str, Any]:
    fit, footage = sequence.fit, sequence.footage
    camera = fit.cameras[0]
    focal, sigma = float(camera.intrinsics[0, 0]), float(fit.focal_sigma_px[0])
    spread = f" \N{PLUS-MINUS SIGN}{sigma:.0f}" if sigma > 0 else ""
    notes = [*footage.notes, f"focal length {footage.focal_source}: {focal:.0f}{spread} px", uncertainty.sentence(1)]
    return {
        "kind": KIND,
        "schema": SCHEMA,
        "status": fit.status,
        "reason": fit.reason,
        "input_hash": hashing.input_hash(sequence.digests, sequence.config),
        "figures": {
            "subject": footage.subject,
            "frames": len(footage.numbers),
            "rms_px": float(np.sqrt(np.nanmean(fit.rms_px**2))),
            "focal_px": focal,
            "focal_sigma_px": sigma,
            "nose_depth_sigma_mm": uncertainty.nose_depth_mm,
            "face_sigma_mm": uncertainty.face_median_mm,
            "seconds": fit.seconds,
            "notes": notes,
        },
        "config": dict(sequence.config),
        "inputs": dict(sequence.digests),
        "versions": hashing.versions(),
        "provenance": dict(sequence.provenance),
    }


def _draw(
    sequence: FittedSequence, folder: Path, progress: Progress
) -> tuple[Float[np.ndarray, "F"] | None, list[tuple[str, Pixels]]]:
    """Write the video and the meshes; return the mouth's opening and the page's stills."""
    video, numbers, options = sequence.video, sequence.footage.numbers.tolist(), sequence.options
    shown = {numbers[k] for k in np.linspace(0, len(numbers) - 1, _STILLS).round().astype(int)}
    chosen = options.mesh_frames() or numbers
    size = even_size(video.width_px, video.height_px, _LONGEST_PX)
    vertices, fitted = _Vertices(sequence), set(numbers)
    writer = VideoWriter(folder / OVERLAY, size, video.rate / video.every) if options.video else None
    stills = []
    try:
        for frame in video.frames():
            mesh = vertices.next() if frame.number in fitted else None
            if mesh is not None and options.meshes is not None and frame.number in chosen:
                _write_mesh(folder / MESHES / f"{frame.number:06d}.{options.meshes}", mesh, sequence.data)
            if writer is not None or frame.number in shown:
                pixels, camera = _reduced(*undistorted(frame.pixels, sequence.fit.cameras[0]), size)
                if mesh is not None:
                    pixels = shaded_over(pixels, mesh, sequence.data.triangles, camera)
                if writer is not None:
                    writer.add(pixels)
                if frame.number in shown:
                    stills.append((f"frame {frame.number}", pixels))
            progress.update(vertices.done, len(numbers), "drawing frames")
    finally:
        if writer is not None:
            writer.close()
    return vertices.opening_mm, stills


class _Vertices:
    """The vertices of the fitted frames in order, and how far the mouth is open in each."""

    def __init__(self, sequence: FittedSequence):
        self._sequence, self.done = sequence, 0
        self._chunk = np.zeros((0, 0, 3))
        self._opening: list[np.ndarray] = []

    def next(self) -> Float[np.ndarray, "V 3"]:
        place = self.done % _CHUNK
        if place == 0:
            sequence = self._sequence
            self._chunk = sequence.fit.vertices(sequence.data, slice(self.done, self.done + _CHUNK))
            opening = mouth_opening_mm(sequence.footage.observations.scheme, self._chunk)
            self._opening += [] if opening is None else [opening]
        self.done += 1
        mesh: np.ndarray = self._chunk[place]
        return mesh

    @property
    def opening_mm(self) -> Float[np.ndarray, "F"] | None:
        return np.concatenate(self._opening) if self._opening else None


def _write_mesh(file: Path, vertices: Float[np.ndarray, "V 3"], data: GNMData) -> None:
    file.parent.mkdir(exist_ok=True)
    if file.suffix == ".obj":
        write_obj(file, vertices, data.triangles, texture_atlas(data), None)
    else:
        file.write_bytes(static_glb(vertices, data.triangles, np.tile(_SKIN, (len(vertices), 1))))


def _reduced(pixels: Pixels, camera: Camera, size_px: tuple[int, int]) -> tuple[Pixels, Camera]:
    if pixels.shape[1::-1] == size_px:
        return pixels, camera
    return cv2.resize(pixels, size_px, interpolation=cv2.INTER_AREA), camera.scaled(*size_px)
