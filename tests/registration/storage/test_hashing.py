"""Digests of nested values differ exactly when the values differ; arrays are hashed by their bytes."""

import time

import numpy as np
import pytest

from registration.storage import hashing


def digest(value) -> str:
    return hashing.input_hash({}, {"value": value})


def test_digests_do_not_depend_on_memory_layout():
    array = np.arange(12.0).reshape(3, 4)
    assert hashing.hash_arrays(array) == hashing.hash_arrays(array.copy(order="F"))
    assert hashing.hash_arrays(array[:, ::2]) == hashing.hash_arrays(array[:, ::2].copy())
    assert digest({"a": 1, "b": (array, "x")}) == digest({"b": [array.copy(), "x"], "a": 1})


@pytest.mark.parametrize(
    "other",
    [
        np.arange(12.0).reshape(4, 3),
        np.arange(12.0, dtype=np.float32).reshape(3, 4),
        np.arange(12).reshape(3, 4),
        np.arange(12.0).reshape(3, 4) + 1e-15 * np.eye(3, 4),
        np.arange(12.0).reshape(3, 4).tolist(),
    ],
    ids=["shape", "precision", "type", "a last bit", "a list"],
)
def test_different_arrays_have_different_digests(other):
    array = np.arange(12.0).reshape(3, 4)
    assert digest(array) != digest(other)
    assert digest({"deep": [1, {"er": array}]}) != digest({"deep": [1, {"er": other}]})


def test_digests_depend_on_order_and_number_of_arrays():
    a, b = np.zeros(3), np.ones(3)
    assert (
        len({hashing.hash_arrays(a, b), hashing.hash_arrays(b, a), hashing.hash_arrays(a), hashing.hash_arrays()}) == 4
    )


def test_large_arrays_are_hashed_quickly():
    """A 2048 x 2048 texture; written out as JSON it took 20 s."""
    texture = np.zeros((2048, 2048, 3), np.float32)
    start_s = time.process_time()
    hashing.hash_arrays(texture)
    assert time.process_time() - start_s < 3
