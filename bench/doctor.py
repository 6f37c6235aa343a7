"""Spoil a good capture in many ways, and try whether the doctor names each fault and mends it; and try good captures.

    python -m bench.doctor CAPTURE [--good CAPTURE...] [--names TEXT...] [--register MODEL.npz]

Each case of `bench/support/spoiled_captures.py` is made from CAPTURE, a native capture folder with all parts. It is
green if the doctor finds exactly the kinds that the table expects and says the mend, and if `--fix` gives the capture
before it was spoiled: cameras, landmarks, pixels, classes and scan are compared. Cases that only a person can mend must
be told, and left alone. Captures of --good must have no error and no warning but of parts that they lack. --register
also registers the mended captures and the good one (`preview`, all views), and prints how far the meshes are apart.
Exit status 1: something is red.
"""

import argparse
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from bench.support.spoiled_captures import SPOILED, Spoiled, make, remove
from registration.capture import pixels
from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.doctor.diagnosis import diagnose
from registration.doctor.mending import mend_capture
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.types import Camera, View

_AS_STORED = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
_EXACT, _NEAR_M, _NEAR_PX = 1e-9, 1e-6, 1e-6  # of numbers; of rounded ones
_NEAR_NORMAL = 4e-4  # of unit vectors; stored lengths above 1 clip when they are encoded in other axes


def examine(case: Spoiled, source: Path, folder: Path) -> tuple[str, list[str]]:
    """Try one case; return what was found and what is wrong with that."""
    target, out = folder / "spoiled", folder / "mended"
    make(source, target, case)
    diagnosis = diagnose(target)
    kinds = [finding.kind for finding in diagnosis.findings]
    text = " ".join(finding.line for finding in diagnosis.findings)
    wrong = [] if set(kinds) == set(case.kinds) else [f"expected {', '.join(case.kinds)}"]
    wrong += [] if re.search(case.says, text, re.DOTALL) else [f"does not say {case.says}"]
    mended = mend_capture(target, out)
    if case.mended == "person":
        wrong += [] if mended.out is None else ["mended what a person must decide"]
    elif mended.out is None or not mended.usable:
        wrong.append("not mended")
    else:
        good = folder / "good"
        shutil.copytree(source, good, copy_function=shutil.copyfile)
        remove(good, case.without)
        wrong += unlike(good, out, turned=case.mended == "turned")
        left = [finding.kind for finding in mended.left.findings]
        wrong += [f"left: {', '.join(left)}"] if left else []
    return ", ".join(kinds), wrong


def unlike(good: Path, mended: Path, *, turned: bool = False) -> list[str]:
    """What differs between two captures; of turned ones only the cameras' places are compared."""
    first, second = read_capture(good), read_capture(mended)
    if [view.name for view in first.views] != [view.name for view in second.views]:
        return ["other views"]
    pairs = list(zip(first.views, second.views, strict=True))
    if turned:
        apart = max(float(np.abs(a.camera.centre - b.camera.centre).max()) for a, b in pairs)
        return [] if apart < _EXACT else [f"cameras are {apart:.1g} m apart"]
    wrong = [f"{b.name}: {what}" for a, b in pairs for what in _unlike_view(a, b)]
    wrong += [] if first.classes == second.classes else [f"classes {', '.join(second.classes)}"]
    if (first.scan is None) != (second.scan is None):
        wrong.append("a scan more or less")
    elif first.scan is not None and second.scan is not None:
        a, b = read_scan(first.scan), read_scan(second.scan)
        apart = float(np.abs(a.vertices - b.vertices).max())
        wrong += [] if apart < _NEAR_M else [f"scan is {apart:.1g} m apart"]
        wrong += (
            [] if (a.triangles == b.triangles).mean() > 0.99 or _same_faces(a.triangles, b.triangles) else ["faces"]
        )
    return wrong


def _same_faces(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether faces are equal but for their order of corners, with the same side out."""
    first = np.stack([np.roll(a, k, 1) for k in range(3)])
    return bool((first == b).all(-1).any(0).all())


def _unlike_view(a: View, b: View) -> list[str]:
    wrong = [] if (apart := _cameras_apart(a.camera, b.camera)) < _EXACT else [f"camera differs by {apart:.1g}"]
    for scheme, points in a.landmarks.items():
        apart = float(np.abs(points - b.landmarks[scheme]).max()) if scheme in b.landmarks else np.inf
        wrong += [] if apart < _NEAR_PX else [f"landmarks {apart:.1g} px apart"]
    for field in ("image", "mask", "normals", "segmentation"):
        one, other = getattr(a, field), getattr(b, field)
        if (one is None) != (other is None):
            wrong.append(f"{field}: one more or less")
        elif one is not None and field == "normals":
            x, y = (_unit_normals(view) for view in (a, b))
            wrong += [] if np.abs(x - y).max() < _NEAR_NORMAL else ["normals differ"]
        elif one is not None:
            x, y = (
                cv2.imread(str(file), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION) for file in (one, other)
            )
            wrong += [] if x.shape == y.shape and (x == y).all() else [f"{field} differs"]
    return wrong


def _unit_normals(view: View) -> np.ndarray:
    """The normal map of a view in its camera's frame; 0 where there is none."""
    normals = pixels.in_camera(pixels.decode_normals(pixels.read_normals(view.normals, view.camera)), view)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 0.5)


def _cameras_apart(a: Camera, b: Camera) -> float:
    size = abs(a.width_px - b.width_px) + abs(a.height_px - b.height_px)
    lens = (
        np.abs(np.subtract(a.distortion, b.distortion)).max(initial=0) if len(a.distortion) == len(b.distortion) else 1
    )
    pose, K = np.abs(a.T_cam_world - b.T_cam_world).max(), np.abs(a.intrinsics - b.intrinsics).max() / a.width_px
    return float(max(size, lens, pose, K))


def false_alarms(capture: Path) -> list[str]:
    """The kinds of what the doctor finds in a good capture."""
    return [f"{finding.severity} {finding.kind}: {finding.line}" for finding in diagnose(capture).findings]


def vertices(capture: Path, model: Path, out: Path) -> np.ndarray:
    """The mesh of a quick registration."""
    return register(capture, model, out, RegisterOptions(recipe="preview", deterministic=True)).vertices


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("--good", nargs="*", type=Path, default=[], metavar="CAPTURE", help="captures without a fault")
    parser.add_argument(
        "--names", nargs="*", default=[], metavar="TEXT", help="only cases whose names hold one of these"
    )
    parser.add_argument("--register", type=Path, metavar="NPZ", help="register what was mended, with this model")
    options = parser.parse_args()
    cases = [case for case in SPOILED if not options.names or any(text in case.name for text in options.names)]
    table = Table("case", "mend", "found", "wrong", "s", show_lines=True)
    red, reference = 0, None
    for case in cases:
        with tempfile.TemporaryDirectory(prefix="doctor-") as name:
            started, folder = time.perf_counter(), Path(name)
            found, wrong = examine(case, options.capture, folder)
            seconds = f"{time.perf_counter() - started:.1f}"
            if options.register and case.mended not in ("person", "turned") and not wrong:
                if case.without or reference is None:
                    target = vertices(folder / "good", options.register, folder / "reference")
                    reference = reference if case.without else target
                else:
                    target = reference
                apart = 1000 * np.linalg.norm(
                    vertices(folder / "mended", options.register, folder / "out") - target, axis=1
                )
                found += f"; registered {apart.mean():.4f} mm apart in the mean"
        red += bool(wrong)
        table.add_row(case.name, case.mended, found, "; ".join(wrong[:3]), seconds)
        print(f"{case.name}: {'red: ' + '; '.join(wrong[:3]) if wrong else 'green'}", flush=True)
    for capture in options.good:
        alarms = false_alarms(capture)
        red += bool(alarms)
        table.add_row(str(capture), "good", "", "; ".join(alarms), "")
        print(f"{capture}: {'red: ' + '; '.join(alarms) if alarms else 'green'}", flush=True)
    Console(width=160).print(table, markup=False)
    print(f"{len(cases)} spoiled and {len(options.good)} good captures, {red} red")
    return 1 if red else 0


if __name__ == "__main__":
    sys.exit(main())
