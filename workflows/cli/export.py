"""`gnmreg export`."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.export.options import ExportOptions
from workflows.cli.options import OptionalModel

_DEFAULTS = ExportOptions()


def export(
    source: Positional[Annotated[Path, arg(metavar="SOURCE")]],
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    /,
    model: OptionalModel = None,
    force: bool = False,
    how: ExportOptions = _DEFAULTS,
) -> int:
    """Write registrations or a model as OBJ, PLY, GLB, USD or Alembic.

    The format follows the suffix of OUT: .obj, .ply, .glb, .usda, .usd, .usdc, .usdz or .abc.

    Args:
        source: A registration folder; a subject's folder that `gnmreg subject` wrote: the neutral, with the expressions
            as shapes; a stabilized set, likewise; any other folder of registrations: a sequence; or a head model's NPZ
            file.
        out: The file to write. Textures and materials that the format has in files of their own go beside it.
        model: The head model of the registrations; not needed if it is where it was then, or in the cache.
        force: Replace files that exist.
        how: What is written.
    """
    from registration.export.write import check_fits, check_out, left_out, write
    from workflows.records.export_source import holds, read_source

    check_out(out, replace=force, filled=how.fills)
    check_fits(out, **holds(source, how))
    found = read_source(source, model, how)
    files = write(found.head, out)
    for note in found.notes:
        print(note)
    if lost := left_out(found.head, out):
        print(f"{out.suffix} does not hold {'; '.join(lost)}")
    print("\n".join(map(str, files)))
    return 0
