"""A calibration as a native capture folder, with its record and pictures."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from registration.calibrate.options import CalibrateOptions
from registration.calibrate.pictures import draw_residuals
from registration.calibrate.result import Calibration
from registration.capture.colmap import write_model
from registration.capture.native_writer import CaptureDescription, check_new, write_settings
from registration.doctor.diagnosis import diagnose
from registration.doctor.rig_picture import draw_rig
from registration.frames import MM_PER_M
from registration.storage.files import atomic_directory, write_json
from registration.types import HeadPose

RECORD, RIG, RESIDUALS = "calibration.json", "rig.png", "residuals.png"
KIND, SCHEMA = "gnm-camera-calibration", 1


def write_calibration(calibration: Calibration, out: Path, options: CalibrateOptions) -> Path:
    """Write a capture of the calibrated photographs, which appears in one rename.

    It holds `capture.toml` with the head's pose, `sparse/`, copies of the photographs in `images/`, and about the
    calibration `calibration.json`, `rig.png` and `residuals.png`.

    Args:
        calibration: to write.
        out: the folder; it must not exist.
        options: of the calibration.

    Returns:
        `out`.

    Raises:
        InputError: `out` exists.
    """
    out = Path(out)
    check_new(out)
    subject = options.subject or calibration.root.resolve().name
    with atomic_directory(out) as temporary:
        cameras = {}
        for view in calibration.views:
            image = temporary / "images" / view.photograph.relative
            image.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(view.photograph.file, image)
            cameras[view.photograph.relative.as_posix()] = view.camera
        write_model(temporary / "sparse", cameras, calibration.points)
        # The world is the head's frame, but for its size where a length was measured.
        head = HeadPose(rotation=np.eye(3), translation=np.zeros(3), scale=calibration.size.head_scale)
        write_settings(
            temporary / "capture.toml",
            CaptureDescription(subject=subject, expression=options.expression, head=head),
        )
        write_json(temporary / RECORD, record(calibration))
        draw_residuals(calibration, temporary / RESIDUALS)
        draw_rig(diagnose(temporary), temporary / RIG)
    return out


def record(calibration: Calibration) -> dict[str, Any]:
    """Return what `calibration.json` holds."""
    return {
        "kind": KIND,
        "schema": SCHEMA,
        "frame": "the head model's: +Y up, +Z out of the face, +X the subject's left; metres",
        "scale_source": calibration.size.source,
        "scale_sigma": calibration.size.sigma,
        "head_scale": calibration.size.head_scale,
        "landmark_scheme": calibration.scheme,
        "landmark_distance_mm": calibration.landmark_distance_mm,
        "points": len(calibration.points),
        "groups": [
            {
                "name": group.name,
                "views": group.views,
                "start_px": group.start_px,
                "start_source": group.source,
                "focal_px": group.focal_px,
                "focal_sigma_px": group.sigma_px,
                "k1": group.k1,
                "k1_sigma": group.k1_sigma,
            }
            for group in calibration.groups
        ],
        "views": {
            view.photograph.name: {
                "focal_px": float(view.camera.intrinsics[0, 0]),
                "focal_sigma_px": view.focal_sigma_px,
                "group": view.group,
                "distance_mm": float(np.linalg.norm(view.camera.centre)) * MM_PER_M,
                "tracks": view.tracks,
                "tracks_rms_px": view.tracks_rms_px,
                "landmarks": view.landmarks,
                "landmarks_rms_px": view.landmarks_rms_px,
            }
            for view in calibration.views
        },
        "left_out": dict(calibration.left_out),
        "notes": list(calibration.notes),
    }
