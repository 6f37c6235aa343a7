"""Write a model file for other programs, in the format that the new file's suffix names."""

from pathlib import Path

from registration.errors import InputError
from registration.model import gnm_npz, gnmw
from registration.storage.files import check_output_file

_NPZ = ".npz"


def export_model(model: Path, out: Path, *, extra_fields: bool = False) -> list[str]:
    """Write a model as GNMW or NPZ.

    Args:
        model: its NPZ file.
        out: the file to write, `NAME.gnmw` or `NAME.npz`.
        extra_fields: for NPZ: write the fields outside the schema into the same file.

    Returns:
        What was written, what it costs and what was left out: a sentence each.

    Raises:
        InputError: the model cannot be read; `out` has another suffix, cannot be written, or is the model itself.
    """
    model, out = Path(model), Path(out)
    suffix = out.suffix.lower()
    if suffix not in (gnmw.SUFFIX, _NPZ) or (extra_fields and suffix != _NPZ):
        expected = _NPZ if extra_fields else f"{gnmw.SUFFIX} or {_NPZ}"
        raise InputError(
            "The format of the new file is not known" if not extra_fields else "A GNMW file has no extra fields",
            where=out,
            expected=f"a name that ends in {expected}",
            got=out.suffix or "no suffix",
            fix="choose another name",
        )
    check_new_model(model, out)
    data = gnm_npz.read(model)
    if suffix == _NPZ:
        gnm_npz.write(data, out, extra_inside=extra_fields)
        written = out if extra_fields or not data.extra else f"{out} and {gnm_npz.extra_path(out)}"
        fields = f"{len(gnm_npz.AXES)} official fields, {len(data.extra)} others"
        return [f"{written}: {fields}", "landmark schemes are files of their own, and not copied"]
    web = gnmw.web_model(data)
    gnmw.write(web, out)
    lines = [f"{out}: {out.stat().st_size:,} bytes"]
    for name, error in gnmw.quantization_error(web, data).items():
        lines.append(
            f"{name}: rounded by at most {error.worst_mm:.4f} mm, {error.rms_mm:.4f} mm rms, for a coefficient of 1"
        )
    return [*lines, "left out: joints, skinning, names, vertex groups, texture coordinates, landmarks"]


def check_new_model(model: Path, out: Path) -> None:
    """Refuse a file for a new model that cannot be written or is the model itself.

    Args:
        model: the model that is read.
        out: the file to write.

    Raises:
        InputError: as said.
    """
    check_output_file(out)
    if out.exists() and model.exists() and out.samefile(model):
        raise InputError(
            "The model would be replaced by its own copy",
            where=out,
            expected="another file than the model",
            got=str(model),
            fix="choose another name",
        )
