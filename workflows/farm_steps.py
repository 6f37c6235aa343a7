"""Steps of the farm: one capture in, one published artifact out. Called in a worker's child with small JSON arguments."""

from pathlib import Path
from typing import Any

from registration import hashes
from registration.capture.native import read
from registration.model import gnm_npz
from registration.model.landmarks import schemes_beside
from registration.progress import Progress
from registration.register import register
from registration.render.backend import Variant
from registration.stages import RECIPES
from workflows.jobs import Unusable
from workflows.local import check_recipe
from workflows.places import capture_here, model_here
from workflows.store import Store

REGISTRATION = "registration"  # the folder within an attempt


def register_stored(
    *,
    capture: str,
    model: str,
    store: str,
    key: str,
    recipe: str = "draft",
    views: int | None = None,
    seed: int = 0,
    variant: Variant = "llvm",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Register a capture and publish the folder under `key`. What was made from the same input is returned at once.

    Raises:
        InputError: as `register`, or an input cannot be fetched.
        Unusable: the registration's status is failed; it is published all the same, for whoever looks into it.
    """
    check_recipe(recipe)
    file = model_here(model)
    data = gnm_npz.read(file)
    schemes = schemes_beside(file, len(data.template_vertex_positions))
    inputs = {f"landmarks {name}": hashes.content_of(one.indices, one.weights) for name, one in schemes.items()}
    inputs["model"] = gnm_npz.content_hash(data)
    with capture_here(capture) as folder:
        inputs["capture"] = hashes.hash_capture(read(folder))
        settings = {"recipe": hashes.plain(RECIPES[recipe]()), "views": views, "seed": seed, "variant": variant}

        def make(attempt: Path) -> dict[str, Any]:
            result = register(
                folder,
                model_path=file,
                out=attempt / REGISTRATION,
                recipe=recipe,
                views=views,
                seed=seed,
                variant=variant,
                progress=progress,
            )
            scan = result.figures.get("scan_to_mesh", {}).get("face")
            return hashes.plain({"status": result.status, "reason": result.reason, "scan_to_mesh_face": scan})

        made = Store(store).produce(key, wanted=hashes.input_hash(inputs, settings), make=make)
    if made.about.get("status") == "failed":
        raise Unusable(f"registration failed: {made.about.get('reason')}")
    return {**made.brief(), "attempt": made.attempt}
