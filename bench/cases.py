"""Try captures with faults that people really had, and print what the product makes of each.

    python -m bench.cases CASES CAPTURE [NAME...] [--model MODEL.npz] [--keep FOLDER]

CASES holds a folder for each case: `make.py SOURCE TARGET`, which makes the faulty capture from a clean one, and
`expected.txt`, which says what is right. For each case the command line checks the capture, and the inputs of a
registration are read; what is accepted is compared with the clean capture: views, pixels, masks, normals, labels,
landmarks, the figure of the scan. A capture whose world moved is registered, and the meshes are compared. A case whose
make.py asks for a REGISTRATION is an evaluation with another subject's capture.

The verdict follows expected.txt: which of "refused", "warned" and "accepted" it allows. A refusal or a warning must
also say the words that are listed here for the case, if any. Exit status 1: a case is red.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.support.case_comparison import differences, moved_by
from coregister.first_model import build
from registration.capture.native import read_capture
from registration.errors import InputError
from registration.inputs import read_inputs
from registration.options import RegisterOptions
from registration.storage.registration_folder import load_registration

# What expected.txt allows, by its words; a clause after "never" or "not" says what is wrong.
_ALLOWED = {
    "refused": r"refus",
    "warned": r"warn|\btold\b|\btells\b|\bsays\b|\bnamed\b",
    "accepted": r"\bworks\b|pass|\bread\b|\breads\b|decoded|as before|as the |registers|thresholded|alpha is the mask"
    r"|as stored|taken as|\bfound\b|view is left out|measured all the same|views are used|\d views|check passes",
}
_MAX_MOVED_MM = 0.05  # rounding elsewhere moves a preview's vertices by 0.03 mm in the mean
_UNLIKE_SOURCE = r"taken as not seen|left out"  # an accepted capture may differ from its source
_ALLOWED_NOW = {"scan_obj": {"accepted"}}  # written when only PLY was read
_WORDS = {  # what a refusal or a warning must say
    "backslash_names": "backslash",
    "empty_view": "cam04",
    "evaluate_other": "another capture|other capture|not the capture",
    "extra_images": "calibrat",
    "fisheye": "undistort",
    "json_bom": "byte.order",
    "labels_celeb": "class",
    "labels_eyes_swapped": "left_eye|right_eye|exchanged",
    "labels_rgb": "grey|gray|colou?r|channel|RGB",
    "landmarks_conf_percent": "confidence",
    "landmarks_flipped": "left and right|mirror",
    "landmarks_suffix": "landmarks/",
    "landmarks_unit": "normali[sz]ed|0 to 1|0\\.\\.1|fractions",
    "landmarks_xy_swapped": "x and y|exchanged|swapped",
    "masks_01": "255",
    "masks_16bit": "16 bit|65535",
    "masks_alpha_black": "alpha",
    "masks_alpha_white": "alpha",
    "masks_jpg": "masks/",
    "missing_image": "missing|no such file",
    "nerfstudio_leftover": "images/",
    "no_landmark_agree_wrong_units_no68": "metre| m ",
    "no_points3d": "points3D",
    "normals_8bit": "16 bit",
    "normals_opengl": "away|OpenGL|axes",
    "normals_y_up": "normal",
    "one_line_nopoints": "line|views",
    "one_line_per_image": "line|POINTS2D",
    "one_view": "at least 2",
    "ply_cm_zup": "scan",
    "ply_inside_out": "inside|orient|face away",
    "ply_mm": "scan|unit|mm",
    "ply_tristrips": "point cloud|strip",
    "ply_unreferenced": "no face|unused",
    "poses_opengl": "OpenGL|behind",
    "sparse_0": "sparse/0",
    "swapped_image": "cam",
    "tiff_float": "float",
    "truth_pickled": "pickle|objects",
    "units_mm": "metre",
    "upper_case_suffix": "case|\\.PNG",
    "utm": "origin",
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the product made of one case."""

    kind: str  # refused, warned or accepted
    said: str  # the refusal, or the warnings that the clean capture does not have
    unlike: tuple[str, ...] = ()  # what differs from the clean capture, if accepted
    fault: str = ""  # what must not happen: a traceback, no refusal at registration

    def verdict(self, name: str, expected: str) -> str:
        """Return "green" or what is wrong."""
        if self.fault:
            return self.fault
        allowed = {kind for kind, words in _ALLOWED.items() if re.search(words, expected)} | _ALLOWED_NOW.get(
            name, set()
        )
        allowed |= {"refused"} if "warned" in allowed else {"warned"} if "accepted" in allowed else set()  # it is said
        if self.kind not in allowed:
            return f"RED: {self.kind}"
        if self.unlike and self.kind == "accepted" and not re.search(_UNLIKE_SOURCE, expected):
            return "RED: differs"
        if self.kind != "accepted" and not re.search(_WORDS.get(name, ""), self.said, re.IGNORECASE):
            return "RED: words"
        return "green"


class Bench:
    """The clean capture, its registration, and a folder to work in."""

    def __init__(self, capture: Path, model: Path, folder: Path):
        self.capture, self.model, self.folder = capture, model, folder
        self.known = set(_warnings(self._command("capture", "check", capture).stdout))

    @cached_property
    def reference(self) -> Path:
        """The registration of the clean capture."""
        out = self.folder / "reference"
        self._register(self.capture, out)
        return out

    def run(self, case: Path) -> Outcome:
        """Make the case and try it."""
        target = self.folder / case.name
        evaluation = "REGISTRATION" in (case / "make.py").read_text("utf-8").split('"""')[1]
        source = self.reference if evaluation else self.capture
        make = [sys.executable, str(case / "make.py"), str(source.resolve()), str(target)]
        subprocess.run(make, check=True, capture_output=True, cwd=self.folder)
        return self._evaluated(target) if evaluation else self._checked(target)

    def _checked(self, target: Path) -> Outcome:
        done = self._command("capture", "check", target)
        if done.returncode:
            said, fault = done.stderr.strip(), _traceback(done.stderr)
            try:
                read_inputs(target, self.model, RegisterOptions())
                fault = fault or "RED: register accepts it"
            except InputError:
                pass
            return Outcome(kind="refused", said=said, fault=fault)
        new = [line for line in _warnings(done.stdout) if line not in self.known]
        try:
            read_inputs(target, self.model, RegisterOptions())
        except InputError as error:
            return Outcome(kind="refused", said=str(error))
        unlike = differences(self.capture, target, load_registration(self.reference))
        shift = moved_by(read_capture(self.capture), read_capture(target))
        if np.linalg.norm(shift) > 1:
            unlike += self._registered_unlike(target, shift)
        return Outcome(kind="warned" if new else "accepted", said="; ".join(new), unlike=tuple(unlike))

    def _registered_unlike(self, target: Path, shift: np.ndarray) -> list[str]:
        out = self.folder / f"{target.name}.registration"
        self._register(target, out)
        if not out.is_dir():
            return ["not registered"]
        moved, reference = load_registration(out), load_registration(self.reference)
        apart = moved.vertices - shift - reference.vertices
        apart_mm = 1000 * float(np.linalg.norm(apart, axis=1).mean())
        unlike = [f"registered {apart_mm:.3f} mm apart in the mean"] if apart_mm > _MAX_MOVED_MM else []
        return unlike + ([] if moved.status == reference.status else [moved.status])

    def _evaluated(self, target: Path) -> Outcome:
        other = next(
            path.parent
            for path in sorted(self.capture.parent.parent.glob("*/neutral/capture.toml"))
            if path.parent != self.capture and (path.parent / "scan.ply").is_file()
        )
        before = (target / "manifest.json").read_bytes()
        done = self._command("evaluate", target, "--capture", other)
        changed = (target / "manifest.json").read_bytes() != before
        kind = "refused" if done.returncode else "warned"
        fault = _traceback(done.stderr) or ("RED: the manifest changed" if changed else "")
        return Outcome(kind=kind, said=done.stdout + done.stderr, fault=fault)

    def _register(self, capture: Path, out: Path) -> None:
        options = ("--recipe", "preview", "--deterministic")
        self._command("register", capture, "--model", self.model, "--out", out, *options)

    def _command(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "workflows.cli", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False)


def _warnings(text: str) -> list[str]:
    return [line.removeprefix("warning: ") for line in text.splitlines() if line.startswith("warning: ")]


def _traceback(text: str) -> str:
    return "RED: traceback" if "Traceback" in text else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, metavar="CASES")
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these cases")
    parser.add_argument("--model", type=Path, metavar="NPZ", help="the head model (default: the first model)")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the captures and registrations here")
    options = parser.parse_intermixed_args()
    folder = options.keep or Path(tempfile.mkdtemp(prefix="cases-"))
    folder.mkdir(parents=True, exist_ok=True)
    found = sorted(path.parent for path in options.cases.resolve().glob("*/make.py"))
    cases = [case for case in found if not options.names or case.name in options.names]
    if missing := set(options.names) - {case.name for case in cases}:
        parser.error(f"no such case: {', '.join(sorted(missing))}")
    table = Table("case", "expected", "result", "verdict", show_lines=True)
    red = 0
    try:
        bench = Bench(options.capture.resolve(), options.model or build.bootstrap(), folder.resolve())
        for case in cases:
            expected = (case / "expected.txt").read_text("utf-8").strip()
            outcome = bench.run(case)
            verdict = outcome.verdict(case.name, expected)
            red += verdict != "green"
            unlike = f"\n[{'; '.join(outcome.unlike[:3])}]" if outcome.unlike else ""
            table.add_row(case.name, expected, f"{outcome.kind}: {outcome.said[:600]}{unlike}", verdict)
            print(f"{case.name}: {outcome.kind}, {verdict}", flush=True)
    finally:
        if options.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    Console(width=160).print(table, markup=False)
    print(f"{len(cases)} cases, {len(cases) - red} green, {red} red")
    return 1 if red else 0


if __name__ == "__main__":
    sys.exit(main())
