"""`gnmreg capture calibrate`: photographs without cameras become a capture."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.calibrate.options import CalibrateOptions
from workflows.cli.options import ModelFile

_DEFAULTS = CalibrateOptions()


def calibrate(
    photographs: Positional[Annotated[Path, arg(metavar="PHOTOGRAPHS")]],
    /,
    *,
    model: ModelFile,
    out: Annotated[Path, arg(metavar="CAPTURE")],
    calibration: CalibrateOptions = _DEFAULTS,
) -> int:
    """Estimate the cameras of photographs of one moment, and write a capture.

    The photographs are a folder of images of one person from several sides. Two at least show the face from about the
    front; others are joined by what they share with these. Size and frame come from the head model.

    Args:
        photographs: Folder of the images, with subfolders.
        model: The head model, a GNM NPZ file.
        out: The capture folder to write; it must not exist.
        calibration: How the photographs are calibrated.
    """
    from registration.calibrate.calibration import calibrate_photographs
    from registration.calibrate.result import summary
    from registration.calibrate.write import write_calibration
    from registration.capture.native_writer import check_new
    from registration.progress import console_progress

    check_new(out)
    with console_progress() as progress:
        result = calibrate_photographs(photographs, model, calibration, progress=progress)
    write_calibration(result, out, calibration)
    print(summary(result))
    print(out)
    return 0
