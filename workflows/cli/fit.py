"""`gnmreg fit`: the model from the landmarks of an image, several images, a capture or a video."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.footage.options import FootageOptions
from workflows.cli.options import Folder, ModelFile

_DEFAULTS = FootageOptions()


def fit(
    source: Positional[Annotated[Path, arg(metavar="INPUT")]],
    /,
    *,
    model: ModelFile,
    out: Folder,
    force: bool = False,
    footage: FootageOptions = _DEFAULTS,
) -> int:
    """Fit the head model to landmarks in an image, images, a capture or a video.

    Needs no cameras: those of images and videos are estimated. The mesh is the model's, without offsets. One moment
    gives a registration's folder, a video a folder with fit.npz, index.html and a video of the mesh.

    Args:
        source: An image; a folder of images of one moment by unknown cameras; a capture folder; or a video.
        model: The head model, a GNM NPZ file.
        out: The folder to write; one that this command wrote before is replaced.
        force: Fit again although the folder holds the result of the same input.
        footage: What is fitted, and how.
    """
    from registration.footage.fit import fit_footage
    from registration.progress import console_progress

    with console_progress() as progress:
        outcome = fit_footage(source, model, out, footage, force=force, progress=progress)
    for note in outcome.notes:
        print(note)
    print(f"{outcome.status}: {outcome.reason}\n{out}")
    return 1 if outcome.status == "failed" else 0
