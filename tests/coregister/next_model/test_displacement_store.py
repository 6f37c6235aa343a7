import numpy as np
import pytest

from coregister.next_model.displacement_store import DisplacementStore


def test_meshes_are_read_as_they_were_written_any_number_of_times():
    meshes = np.random.default_rng(0).normal(size=(131, 17, 3)).astype(np.float32)
    with DisplacementStore(131, 17) as store:
        for mesh in meshes[:100]:
            store.append(mesh)
        assert np.array_equal(np.stack(list(store)), meshes[:100])
        for mesh in meshes[100:]:
            store.append(mesh.astype(np.float64))
        for _ in range(2):
            assert store.count == 131 and np.array_equal(np.stack(list(store)), meshes)
        with pytest.raises(ValueError):
            store.append(meshes[0, :16])
