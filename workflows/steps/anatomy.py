"""`gnmreg model anatomy`: eyes, teeth, tongue and pupils of a model, regenerated from data of their own."""

import shutil
from pathlib import Path

from coregister.anatomy.assemble import AnatomySettings, manifest, regenerate
from coregister.next_model import provenance
from registration.errors import InputError
from registration.model import gnm_npz
from registration.progress import Progress
from registration.storage.files import atomic_file, check_output_file


def write_anatomy(model: Path, out: Path, settings: AnatomySettings, progress: Progress) -> list[str]:
    """Regenerate parts of a model and write it with its manifest, landmark schemes and expression statistics.

    Args:
        model: a GNM NPZ file.
        out: the file to write, NAME.npz, with NAME.manifest.json beside it.
        settings: parts and seed.
        progress: receives the steps.

    Returns:
        What was made: a sentence for each part, and one for the layout.

    Raises:
        InputError: before anything is written: the model cannot be read or lacks a part's structure, the settings are
            invalid, or `out` is the model itself or no NPZ file that can be written.
    """
    settings.check()
    if out.suffix.lower() != ".npz":
        raise InputError("The new model has no NPZ file's name", where=out, expected="NAME.npz", got=out.name)
    check_output_file(out)
    if out.exists() and model.exists() and out.samefile(model):
        raise InputError(
            "The model would be replaced by its own copy",
            where=out,
            expected="another file than the model",
            got=str(model),
            fix="choose another name",
        )
    data = gnm_npz.read(model)
    progress.message(f"regenerating {', '.join(settings.parts)}")
    made = regenerate(data, settings)
    coefficients = model.with_name(f"{model.stem}.expressions.npz")
    if coefficients.is_file():  # the statistics of the skin's components, which are kept
        out.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(out.with_name(f"{out.stem}.expressions.npz")) as temporary:
            shutil.copyfile(coefficients, temporary)
    provenance.write(made.data, manifest(made, data, settings), None, out, model)
    lines = []
    for part, record in made.anatomy["parts"].items():
        kept = f"{record['variance_kept']:.2%} of the variance"
        lines.append(f"{part}: {record['components']} components of {record['samples']} samples, {kept}")
    layout = ", ".join(f"{name} {count}" for name, count in made.anatomy["layout"].items())
    return [*lines, f"components: {layout}"]
