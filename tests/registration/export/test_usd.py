"""USD files of heads, opened by usd-core."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.export.registrations import head_of_registration
from registration.export.usd import prim_names
from registration.export.write import write
from tests.registration.export.heads import DATA, a_registration

pxr = pytest.importorskip("pxr", reason="usd-core is not installed")

HEAD = head_of_registration(a_registration(), DATA, name='anna "quoted" \\ ü')
SHAPES = {"smile": DATA.expression_basis[3].astype(np.float64), "lid up 50 %": DATA.expression_basis[0].astype(float)}
SUFFIXES = (".usda", ".usd", ".usdc", ".usdz")


def opened(file: Path):
    from pxr import Usd, UsdGeom, UsdValidation

    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y"
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    kinds = [(str(error.GetType()), error.GetMessage()) for error in errors]
    assert not [message for kind, message in kinds if kind.endswith("Error")], kinds
    assert stage.GetDefaultPrim().GetPath() == "/head"
    return stage


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_usd_core_reads_what_was_exported(suffix: str, tmp_path: Path) -> None:
    from pxr import UsdGeom, UsdShade

    files = write(HEAD, tmp_path / f"head{suffix}")
    assert [file.name for file in files] == [f"head{suffix}"] + (["head.png"] if suffix != ".usdz" else [])
    stage = opened(files[0])
    assert stage.GetDefaultPrim().GetDisplayName() == HEAD.name
    mesh = UsdGeom.Mesh.Get(stage, "/head/mesh")
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), HEAD.vertices.astype(np.float32))
    np.testing.assert_array_equal(mesh.GetNormalsAttr().Get(), HEAD.normals.astype(np.float32))
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {4}
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4), DATA.quads)
    assert mesh.GetNormalsInterpolation() == "vertex" and mesh.GetSubdivisionSchemeAttr().Get() == "none"
    uvs = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    assert uvs.GetInterpolation() == "faceVarying"
    np.testing.assert_array_equal(np.array(uvs.ComputeFlattened()).reshape(-1, 4, 2), HEAD.topology.face_uvs)
    subsets = UsdGeom.Subset.GetAllGeomSubsets(mesh)
    assert [subset.GetPrim().GetName() for subset in subsets] == ["skin", "eyes", "teeth", "tongue"]
    for number, subset in enumerate(subsets):
        np.testing.assert_array_equal(
            subset.GetIndicesAttr().Get(), np.flatnonzero(HEAD.topology.face_material == number)
        )
        material, _ = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()
        assert material.GetPrim().GetName() == subset.GetPrim().GetName()
        shader = UsdShade.Shader.Get(stage, material.GetPath().AppendChild("texture"))
        image = shader.GetInput("file").Get()
        assert shader.GetInput("sourceColorSpace").Get() == "sRGB" and image.resolvedPath.rstrip("]").endswith(
            "head.png"
        )


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_blend_shapes_move_the_points_by_the_expressions(suffix: str, tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdSkel

    [file, *_] = write(replace(HEAD, shapes=SHAPES), tmp_path / f"head{suffix}")
    stage = opened(file)
    names = ["smile", "lid_up_50__"]
    for name, (title, shape) in zip(names, SHAPES.items(), strict=True):
        blend = UsdSkel.BlendShape.Get(stage, f"/head/mesh/{name}")
        assert blend.GetPrim().GetDisplayName() == title
        found = np.zeros_like(HEAD.vertices)
        found[np.array(blend.GetPointIndicesAttr().Get())] = blend.GetOffsetsAttr().Get()
        np.testing.assert_allclose(found, shape, atol=1e-9)
    if suffix == ".usda":  # USD's own evaluation of the weights
        animation = UsdSkel.Animation.Get(stage, "/head/animation")
        assert list(animation.GetBlendShapesAttr().Get()) == names
        animation.GetBlendShapeWeightsAttr().Set([1.0, 0.5])
        assert UsdSkel.BakeSkinning(UsdSkel.Root.Get(stage, "/head"))
        points = UsdGeom.Mesh.Get(stage, "/head/mesh").GetPointsAttr().Get(Usd.TimeCode.EarliestTime())
        expected = HEAD.vertices + SHAPES["smile"] + 0.5 * SHAPES["lid up 50 %"]
        np.testing.assert_allclose(points, expected, atol=1e-6)


def test_a_sequence_has_time_samples(tmp_path: Path) -> None:
    from pxr import UsdGeom

    frames = np.stack([HEAD.vertices + k * SHAPES["smile"] for k in range(3)]).astype(np.float32)
    [file, *_] = write(replace(HEAD, frames=frames, frames_per_second=25), tmp_path / "head.usda")
    stage = opened(file)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 25)
    points = UsdGeom.Mesh.Get(stage, "/head/mesh").GetPointsAttr()
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(points.Get(number), frame)


def test_names_become_names_that_usd_accepts() -> None:
    assert prim_names(["a", "a b", "a-b", "3d", "", "ü"]) == ["a", "a_b", "a_b_2", "_3d", "_", "__2"]
