"""Whether a model of a size can be built, before anything is registered for it."""

import shutil
import tempfile
from pathlib import Path

from coregister.next_model import identity
from coregister.next_model.recipes import ModelRecipe
from coregister.next_model.training_data import check_rank
from coregister.region_masks import REGIONS
from registration.errors import InputError
from registration.geometry import pca
from registration.model.gnm_npz import GNMData

_FEWEST = 20  # components, where their number is not given: a basis of fewer is none


def check_recipe(neutrals: int, expressions: int, prior: GNMData, recipe: ModelRecipe) -> None:
    """Refuse a recipe whose bases cannot be computed from so many meshes.

    Args:
        neutrals: number of them.
        expressions: number of them.
        prior: the model that the identity basis is shrunk towards, in the topology of the meshes.
        recipe: its memory and numbers of components.

    Raises:
        InputError: the samples span fewer components than requested, or the memory has no room for them.
    """
    head_components = len(prior.vertex_identity_basis) - len(identity.transfer_components(prior))
    check_rank(
        neutrals,
        recipe.identity.max_components,
        previous=head_components if recipe.identity.shrinkage != 0 else 0,
        mirrored=recipe.identity.mirrored,
    )
    size = 3 * len(prior.template_vertex_positions)
    requested = {"identity": (neutrals + head_components, recipe.identity.max_components)}
    if expressions:
        requested |= {
            region: (expressions, (recipe.expressions.max_components or {}).get(region)) for region in REGIONS
        }
    for part, (count, components) in requested.items():
        needed = pca.sketch_gb(size, components or _FEWEST)
        if not pca.is_exact(count, size, recipe.memory_gb) and needed > recipe.memory_gb:
            raise InputError(
                "The memory has no room for a basis",
                where=f"memory_gb of the model recipe, {part}",
                expected=f"at least {needed:.2f} GB for {components or _FEWEST} components of {size // 3} vertices",
                got=recipe.memory_gb,
                fix="give more memory, or request fewer components",
            )


def check_disk(expressions: int, vertices: int) -> None:
    """Refuse more expressions than the folder of temporary files has room for.

    Raises:
        InputError: it has less free than the displacements need.
    """
    folder = Path(tempfile.gettempdir())
    needed, free = 12 * vertices * expressions, shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            "There is too little disk for the expressions",
            where=folder,
            expected=f"{needed / 1e9:.1f} GB free: {expressions} displacements of {vertices} vertices",
            got=f"{free / 1e9:.1f} GB",
            fix="free some, or set TMPDIR to a folder with more",
        )
