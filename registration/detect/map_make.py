"""The map from a detector's landmarks to a model's surface: rendered, detected, solved, measured and checked."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from registration.detect import face478_points as named
from registration.detect.face478 import SCHEME as FACE478
from registration.detect.map_checks import Check, check_map
from registration.detect.map_regions import regions_of
from registration.detect.map_renders import Observations, RenderSettings, observe
from registration.detect.map_solve import held_out_errors, solve, spread
from registration.detect.provider import LandmarkProvider
from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.model import gnm_npz
from registration.model.landmarks import KIND, VERSION, LandmarkScheme
from registration.progress import NullProgress, Progress

SPREAD = (
    "standard deviation along each axis, m, of landmarks triangulated over the views of held-out renders "
    "around the map's point"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class MadeMap:
    """A solved map and what was measured."""

    scheme: LandmarkScheme
    checks: list[Check]  # none for schemes whose points have no names
    regions_mm: Mapping[str, float]  # rms spread of groups of landmarks
    found: float  # fraction of the pictures with a face


def make_map(
    data: gnm_npz.GNMData,
    provider: LandmarkProvider,
    expressions: Mapping[str, Float[np.ndarray, "V 3"]],
    settings: RenderSettings,
    progress: Progress | None = None,
) -> MadeMap:
    """Make the map of a provider's landmarks on a model. Minutes.

    Args:
        data: the model.
        provider: the detector.
        expressions: displacements by name, metres.
        settings: number of heads, seed.
        progress: receives the steps.

    Raises:
        InputError: as `observe`.
    """
    observations = observe(data, provider, expressions, settings, progress)
    return map_of(data, provider, expressions, settings, observations, progress)


def map_of(
    data: gnm_npz.GNMData,
    provider: LandmarkProvider,
    expressions: Mapping[str, Float[np.ndarray, "V 3"]],
    settings: RenderSettings,
    observations: Observations,
    progress: Progress | None = None,
) -> MadeMap:
    """Solve, measure and check a map from observations; arguments as `make_map`."""
    progress = progress or NullProgress()
    name, is_face478 = provider.scheme, provider.scheme == FACE478
    areas = regions_of(data, name)
    held_out = held_out_errors(data, observations, areas, name, progress)
    scheme = solve(data, observations, areas, name)
    views = observations.pixels.shape[1]
    header = {
        "kind": KIND,
        "version": str(VERSION),
        "scheme": name,
        "provider": provider.version,
        "topology": gnm_npz.topology_hash(data.triangles),
        "model": gnm_npz.content_hash(data),
        "options": f"seed {settings.seed}, {settings.identities} people, {settings.expressions} expressions of each, "
        f"{views} views",
        "spread": SPREAD,
    }
    scheme = replace(scheme, spread_m=spread(held_out, observations.opposite), header=header)
    assert scheme.spread_m is not None
    groups = named.REGIONS if is_face478 else {}
    grouped = {index for group in groups.values() for index in group}
    groups = {**groups, "other": tuple(i for i in range(provider.count) if i not in grouped)}
    return MadeMap(
        scheme=scheme,
        checks=check_map(data, scheme, tuple(observations.opposite.tolist()), expressions) if is_face478 else [],
        regions_mm={
            group: MM_PER_M * float(np.sqrt(np.mean(scheme.spread_m[list(members)] ** 2)))
            for group, members in groups.items()
            if members
        },
        found=observations.found,
    )


def refuse_failed(made: MadeMap) -> None:
    """Raise InputError if a check of the map failed."""
    failed = [f"{check.name}: {check.detail}" for check in made.checks if not check.passed]
    if failed:
        raise InputError(
            "The landmark map fails its checks",
            where=made.scheme.name,
            expected="lids, lips, irises and both sides where they are on the model",
            got="; ".join(failed),
            fix="render more people with --identities, and check the model's vertex groups",
        )
