"""A subject's own teeth: one synthetic person with a random dentition in four captures, `draft`; for the reconstructed
GNM file, the captures of one identity with its happy face. Minutes.

Crowns are measured twice, in every capture's world and with each arch aligned rigidly to the true one, which leaves the
dentition itself. "Alone" is the neutral's estimate, which every expression used before captures shared their teeth.
"""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bench.anatomy_checks import Figure
from bench.anatomy_parts import SHARED
from coregister.anatomy.assemble import AnatomySettings, identity_order, regenerate
from coregister.first_model import assembly, build, makehuman
from coregister.first_model.population import mean_person
from coregister.synthetic import expressions
from coregister.synthetic.capture import Studio, render_capture
from coregister.synthetic.subject import sample_subject
from registration.anatomy.own_parts import OwnParts, found_alone, with_parts
from registration.anatomy.tooth_structure import DentalArch, find_teeth
from registration.capture.scan import read_truth
from registration.frames import MM_PER_M
from registration.geometry.rigid import align
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme, schemes_beside
from registration.options import RegisterOptions
from registration.storage.registration_folder import load_registration
from workflows.steps.subject import register_subject

CAPTURES = ("neutral", "smile", "jaw_open", "stretch")  # the last shows the teeth
_SEED = 41
_IDENTITY = SHARED / "captures" / "gnm_identity_a"
_OPTIONS = RegisterOptions(recipe="draft")


def figures(data: GNMData, out: Path | None = None) -> Iterator[Figure]:
    """Register the subject of this model, if there is one, with components of teeth.

    Args:
        data: the model.
        out: a folder that keeps model, captures and registrations for the next run, which fits only what has changed;
            None for one that is deleted.
    """
    first = build.bootstrap()
    is_first = gnm_npz.topology_hash(data.triangles) == gnm_npz.topology_hash(gnm_npz.read(first).triangles)
    beside = first.parent if is_first else SHARED / "gnm"
    with tempfile.TemporaryDirectory() if out is None else contextlib.nullcontext(out) as folder:
        model = Path(folder) / "model" / "model.npz"
        model.parent.mkdir(parents=True, exist_ok=True)
        if not model.is_file():
            gnm_npz.write(regenerate(data, AnatomySettings(parts=("teeth",))).data, model)
        made = gnm_npz.read(model)
        for scheme in beside.glob("head_sparse_*.txt"):
            shutil.copy(scheme, model.parent)
        if is_first:
            yield from _synthetic(data, made, model, Path(folder))
        elif _IDENTITY.is_dir():
            yield from _happy(model, Path(folder))


def _happy(model: Path, folder: Path) -> Iterator[Figure]:
    register_subject(_IDENTITY, model, folder / "out", _OPTIONS)
    for name, most in (("neutral", None), ("happy", 0.20)):
        error = load_registration(folder / "out" / name).figures["vertex_error"]["face"]["mean_mm"]
        yield Figure(name=f"{name}, vertex error of the face", value=error, unit="mm", most=most)


def _synthetic(data: GNMData, made: GNMData, model: Path, folder: Path) -> Iterator[Figure]:
    own = np.random.default_rng(_SEED).standard_normal(len(identity_order(made)["teeth"]))
    shift = made.template_vertex_positions.astype(np.float64) - data.template_vertex_positions
    shift += np.tensordot(own, made.vertex_identity_basis[identity_order(made)["teeth"]].astype(np.float64), 1)
    schemes = schemes_beside(model, made.template_vertex_positions)
    for name in CAPTURES:
        if not (folder / "captures" / name).is_dir():
            _render(folder / "captures" / name, name, data, shift, schemes)
    register_subject(folder / "captures", model, folder / "out", _OPTIONS)
    yield from measured(made, folder / "out", folder / "captures", schemes)


def measured(made: GNMData, out: Path, captures: Path, schemes: Mapping[str, LandmarkScheme]) -> Iterator[Figure]:
    """Distances of the crowns from the truth in all captures, before and after they share their teeth."""
    parts, arches = OwnParts.of(made), find_teeth(made)
    results = {name: load_registration(out / name) for name in CAPTURES}
    alone = parts.coefficients(found_alone(results["neutral"], made, parts, schemes))
    for title, most in (("of the neutral alone", None), ("of all captures", 0.6)):
        world, shape = [], []
        for name, result in results.items():
            if most is None:
                result = with_parts(result, made, parts, alone, schemes)
            truth = read_truth(captures / name / "ground_truth.npz")
            for arch in arches:
                distances = _crowns(arch, result.vertices.astype(np.float64), truth.astype(np.float64))
                world.append(distances[0])
                shape.append(distances[1])
        yield Figure(name=f"crowns from the truth, teeth {title}", value=float(np.mean(world)), unit="mm", most=most)
        yield Figure(name=f"the same, arches aligned, teeth {title}", value=float(np.mean(shape)), unit="mm")


def _crowns(arch: DentalArch, found: Float[np.ndarray, "V 3"], truth: Float[np.ndarray, "V 3"]) -> tuple[float, float]:
    """Mean distance of the crowns' vertices, mm: as they are, and after a rigid alignment of the arch."""
    rows = np.concatenate([tooth.vertices[tooth.crown] for tooth in arch.teeth])
    T = align(found[rows][None], truth[rows], np.ones((1, len(rows))))[0]
    aligned = found[rows] @ T[:3, :3].T + T[:3, 3]
    return tuple(MM_PER_M * float(np.linalg.norm(p - truth[rows], axis=1).mean()) for p in (found[rows], aligned))  # type: ignore[return-value]


def _render(
    root: Path, name: str, data: GNMData, shift: Float[np.ndarray, "V 3"], schemes: Mapping[str, LandmarkScheme]
) -> None:
    """Render an expression of one person whose teeth differ from the first model's by `shift`."""
    heads = assembly.build_assembly(makehuman.read(makehuman.fetch()), mean_person())
    person, performed = sample_subject(_SEED), expressions.expression_by_name(name)
    neutral, joints = heads.assemble(person, {target: heads.source.target(target) for target in person.weights})
    vertices = expressions.apply_expression(heads, performed, neutral, joints)
    lower = regions.lower_teeth(data)
    turned = align(neutral[lower][None], vertices[lower], np.ones((1, int(lower.sum()))))[0][:3, :3]
    moved = np.where(lower[:, None], shift @ turned.T, shift)
    render_capture(
        root,
        data=data,
        vertices=vertices + moved,
        schemes=schemes,
        subject="own_teeth",
        expression=name,
        tags={"category": performed.category},
        studio=replace(Studio(), seed=_SEED),
    )
