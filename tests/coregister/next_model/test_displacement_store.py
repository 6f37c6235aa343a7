import numpy as np
import pytest

from coregister.next_model.displacement_store import DisplacementStore


def test_what_goes_in_comes_out_as_often_as_it_is_read():
    meshes = np.random.default_rng(0).normal(size=(131, 17, 3)).astype(np.float32)
    with DisplacementStore(131, 17) as spool:
        for mesh in meshes[:100]:
            spool.append(mesh)
        assert np.array_equal(np.stack(list(spool)), meshes[:100])
        for mesh in meshes[100:]:
            spool.append(mesh.astype(np.float64))
        for _ in range(2):
            assert spool.count == 131 and np.array_equal(np.stack(list(spool)), meshes)
        with pytest.raises(ValueError):
            spool.append(meshes[0, :16])
