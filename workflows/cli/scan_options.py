"""The options of `gnmreg register --scan`: a scan without photographs."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from registration.errors import InputError
from registration.options import RegisterOptions
from workflows.cli.options import NOT_SET, OptionalFile, OptionalFolder

if TYPE_CHECKING:
    from registration.progress import Progress


@dataclass(frozen=True, kw_only=True)
class ScanOptions:
    """A scan to register instead of a capture.

    Attributes:
        scan: A mesh without photographs (PLY, OBJ, GLB, glTF): virtual cameras around it make the capture.
        scan_landmarks: Points picked on the scan, in its unit and axes (.ljson, .pp, .json, .txt, .npz), in the order
            of scheme 68 or of SCHEME. Without them the head is found by the shape of the face.
        unit: Unit of the scan; by default the one in which the head has a head's size.
        scan_capture: Where to keep the capture that is made of the scan.
    """

    scan: OptionalFile = None
    scan_landmarks: Annotated[str | None, arg(metavar="[SCHEME=]FILE", help_behavior_hint=NOT_SET)] = None
    unit: Annotated[Literal["m", "mm", "cm", "in"] | None, arg(help_behavior_hint="(default: found)")] = None
    scan_capture: OptionalFolder = None

    def check(self, capture: Path | None) -> None:
        """Refuse both a capture and a scan, or neither. Raises InputError."""
        if (capture is None) == (self.scan is None):
            raise InputError(
                "One thing is registered at a time",
                where="gnmreg register",
                expected="a capture folder, or a scan with --scan",
                got="neither" if capture is None else "both",
                fix="a capture's own scan is read from its folder; give one of the two",
            )
        given = {"--scan-landmarks": self.scan_landmarks, "--unit": self.unit, "--scan-capture": self.scan_capture}
        if self.scan is None and (useless := [name for name, value in given.items() if value is not None]):
            raise InputError(
                "An option counts only with a scan",
                where=", ".join(useless),
                expected="--scan beside it",
                got="a capture folder",
                fix="give --scan, or leave the option out",
            )

    def capture(
        self, model: Path, out: Path, fit: RegisterOptions, progress: "Progress"
    ) -> tuple[Path, RegisterOptions]:
        """Make the capture of the scan, or find it made of the same files; its registration says what was found.

        Args:
            model: the head model.
            out: of the registration; the capture lies beside it unless `scan_capture` says where.
            fit: how the capture will be registered.
            progress: where to report to.

        Returns:
            The capture, and options with which its surface is fitted.

        Raises:
            InputError: the scan, its landmarks or the model cannot be used.
        """
        from registration.inputs import read_schemes
        from registration.model import gnm_npz
        from registration.scan_capture.make import ScanSource, make_capture
        from registration.storage.registration_folder import check_output_folder

        assert self.scan is not None
        check_output_folder(out)
        scheme, _, file = (self.scan_landmarks or "").rpartition("=")
        source = ScanSource(
            file=self.scan, landmarks=Path(file) if file else None, scheme=scheme or None, unit=self.unit
        )
        data = gnm_npz.read(model)
        root = self.scan_capture or Path(f"{out.absolute()}_capture")
        made = make_capture(source, root, data, read_schemes(model, data, fit.landmark_files), progress)
        progress.message(f"the capture of the scan: {made.root}")
        return made.root, replace(fit, use_scan="always") if fit.use_scan == "auto" else fit
