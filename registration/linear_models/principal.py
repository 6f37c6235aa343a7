"""What models of principal components have in common: bases of unit length with variances, triangles from MATLAB."""

import numpy as np
from jaxtyping import Float, Int, Num

from registration.errors import InputError

_UNIT = 0.02  # deviation of a component's length from 1


def scaled_basis(
    basis: Num[np.ndarray, "A B"], deviations: Float[np.ndarray, "K"], vertices: int, where: object
) -> tuple[Float[np.ndarray, "K V 3"], str | None]:
    """Return components in standard deviations, and a remark if the file did not have the usual scale.

    Args:
        basis: 3V x K or K x 3V, coordinates of a vertex side by side.
        deviations: the standard deviation of each component.
        vertices: V.
        where: the file, for messages.

    Raises:
        InputError: the shapes do not belong together, or a deviation is negative or not finite.
    """
    K = len(deviations)
    if basis.shape == (3 * vertices, K):
        basis = basis.T
    elif basis.shape != (K, 3 * vertices):
        expected, got = f"{3 * vertices} x {K} numbers, either way round", basis.shape
        raise _error("components", where, expected, got)
    if not (np.isfinite(deviations).all() and (deviations >= 0).all()):
        raise _error("variances", where, "finite numbers from 0", f"{deviations.min():g} to {deviations.max():g}")
    components = np.ascontiguousarray(basis, np.float32)
    lengths = np.sqrt(np.einsum("kv,kv->k", components, components, dtype=np.float64))
    used = (lengths > 0) & (deviations > 0)
    remark = None
    if np.allclose(lengths[used], deviations[used], rtol=_UNIT) and not np.allclose(lengths[used], 1, atol=_UNIT):
        remark = "the components have the length of their deviations already"
    else:
        components *= deviations[:, None].astype(np.float32)
        if not np.allclose(lengths[used], 1, atol=_UNIT):
            remark = f"the components have lengths from {lengths[used].min():.3g} to {lengths[used].max():.3g}, not 1"
    return components.reshape(K, vertices, 3), remark


def triangles_from_0(indices: Int[np.ndarray, "A B"], vertices: int, where: object) -> Int[np.ndarray, "F 3"]:
    """Return triangles with indices from 0, from 3 x F or F x 3 indices that count from 0 or, as MATLAB's, from 1.

    Raises:
        InputError: there are no three corners, or an index is out of range.
    """
    if 3 not in indices.shape or indices.ndim != 2 or not indices.size:
        raise _error("triangles", where, "three corners each", f"the shape {indices.shape}")
    triangles = indices if indices.shape[1] == 3 else indices.T
    first, last = int(triangles.min()), int(triangles.max())
    if last == vertices and first >= 1:
        triangles = triangles - 1
    elif first < 0 or last >= vertices:
        raise _error("triangles", where, f"indices of {vertices} vertices", f"{first} to {last}")
    return np.ascontiguousarray(triangles, np.int64)


def vertex_rows(coordinates: Num[np.ndarray, "*A"], where: object) -> Float[np.ndarray, "V 3"]:
    """Return a mean shape as V x 3, from 3V numbers side by side, or V x 3 or 3 x V of them.

    Raises:
        InputError: it has another shape.
    """
    array = np.asarray(coordinates, np.float64)
    if array.ndim == 2 and array.shape[1] == 3 and array.shape[0] > 1:
        return array
    if array.ndim == 2 and array.shape[0] == 3 and array.shape[1] > 1:
        return np.ascontiguousarray(array.T)
    if array.size and array.size % 3 == 0 and array.size == max(array.shape, default=0):
        return array.reshape(-1, 3)
    raise _error("mean", where, "three coordinates of each vertex", f"the shape {array.shape}")


def _error(what: str, where: object, expected: object, got: object) -> InputError:
    fix = "use the model's file as it was published"
    return InputError(f"The linear model's {what} cannot be used", where=where, expected=expected, got=got, fix=fix)
