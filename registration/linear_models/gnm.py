"""GNM files as linear models."""

from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.linear_models.data import Joints, LinearModelData, check
from registration.linear_models.npz_names import array_names
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.model import gnm_npz, info
from registration.model.gnm_npz import GNMData
from registration.storage.hashing import hash_file

JAW = "jaw"


def read(path: Path, options: ReadOptions) -> LinearModelData:
    """Read a GNM file. Raises InputError as `gnm_npz.read`; the axes and the unit are GNM's own."""
    data = gnm_npz.read(path)
    licence = info.origin(path, hash_file(path))[1]
    terms = "not recorded beside the file" if licence == "not recorded" else licence
    model = from_gnm(data, licence=f"licence of the file: {terms}")
    check(model, path)
    if not options.without_jaw:
        return model
    if JAW in model.joints.names[1:]:
        return model.without_joint(JAW)
    raise InputError(
        "The model has no jaw joint",
        where=path,
        expected="a model with a jaw joint, such as FLAME",
        got=f"a GNM file with the joints {', '.join(model.joints.names)}",
        fix="read it without the option; GNM's expressions open the mouth",
    )


def from_gnm(data: GNMData, *, licence: str = "that of the model's file") -> LinearModelData:
    """Return a GNM model in the form of all linear models; its coefficients are in standard deviations already."""
    weights = data.skinning_weights.astype(np.float64)
    correctives = data.pose_correctives_regressor
    joints = Joints(
        names=tuple(map(str, data.joint_names)),
        parents=np.maximum(data.joint_parent_indices.astype(np.int64), -1),
        template=data.template_joint_positions.astype(np.float32),
        identity_basis=data.joint_identity_basis.astype(np.float32),
        expression_basis=np.zeros((len(data.expression_basis), *data.template_joint_positions.shape), np.float32),
        # The inverse homogeneous map [GNM, Model Formulation] divides by the sum of a vertex' weights.
        weights=(weights / weights.sum(0)).T,
        correctives=correctives.astype(np.float32) if correctives.any() else None,
    )
    return LinearModelData(
        name=f"GNM {data.variant} {data.version}",
        format="gnm",
        licence=licence,
        triangles=data.triangles.astype(np.int64),
        template=data.template_vertex_positions.astype(np.float32),
        identity_basis=data.vertex_identity_basis.astype(np.float32),
        expression_basis=data.expression_basis.astype(np.float32),
        joints=joints,
        remarks=data.remarks,
        groups={
            str(name): weight > 0.5 for name, weight in zip(data.vertex_group_names, data.vertex_groups, strict=True)
        },
    )


def _detect(path: Path) -> bool:
    names = array_names(path)
    return len(names & gnm_npz.AXES.keys()) >= len(gnm_npz.AXES) // 2


FORMAT = ModelFormat(name="gnm", title="GNM (NPZ)", detect=_detect, read=read)
