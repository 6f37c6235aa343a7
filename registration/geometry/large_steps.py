"""Large steps (Nicolet 2021): smooth displacements through a preconditioner, and quadratic penalties on them.

The unknown is u = M d with M = I + lambda L, L the combinatorial Laplacian; d = M^-1 u and dLoss/du = M^-1 dLoss/dd.
On a regular triangulation of edge length h this smooths over l = h sqrt(1.5 lambda). Lambda may vary from edge to edge,
so that l is what was asked for where edges are longer, or where it is asked to be another.
"""

import warnings
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor


def spacing(triangles: Int[np.ndarray, "F 3"], points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
    """The mean length of each vertex' edges; the median of all for vertices without."""
    adjacency = _adjacency(triangles, len(points)).tocoo()
    length = np.linalg.norm(points[adjacency.row].astype(np.float64) - points[adjacency.col], axis=1)
    count = np.bincount(adjacency.row, minlength=len(points))
    total = np.bincount(adjacency.row, weights=length, minlength=len(points))
    return np.where(count > 0, total / np.maximum(count, 1), np.median(length))


def combinatorial_laplacian(
    triangles: Int[np.ndarray, "F 3"], vertex_count: int, strength: Float[np.ndarray, "V"] | None = None
) -> csr_matrix:
    """L = D - A over the mesh's edges, (V, V); every row sums to zero. Edges count the mean strength of their ends."""
    adjacency = _adjacency(triangles, vertex_count)
    if strength is not None:
        scaled = diags(strength)
        adjacency = (scaled @ adjacency + adjacency @ scaled) / 2
    return (diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsr()


def normalised_laplacian(triangles: Int[np.ndarray, "F 3"], vertex_count: int) -> csr_matrix:
    """D^-1 (D - A): a vertex minus the mean of its neighbours, (V, V); empty rows for isolated vertices."""
    adjacency = _adjacency(triangles, vertex_count)
    degree = np.asarray(adjacency.sum(1)).ravel()
    return (diags(1 / np.maximum(degree, 1)) @ (diags(degree) - adjacency)).tocsr()


def _adjacency(triangles: Int[np.ndarray, "F 3"], vertex_count: int) -> csr_matrix:
    start = np.concatenate([triangles[:, k] for k in range(3)])
    end = np.concatenate([triangles[:, (k + 1) % 3] for k in range(3)])
    one_way = coo_matrix((np.ones(len(start)), (start, end)), (vertex_count, vertex_count)).tocsr()
    return ((one_way + one_way.T) > 0).astype(np.float64)


def to_torch(matrix: csr_matrix, device: torch.device) -> Tensor:
    """A SciPy sparse matrix as a float32 torch one, for products that carry gradients."""
    matrix = matrix.tocsr()
    with warnings.catch_warnings():
        # A product is 30 times faster than with COO, which would not warn.
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
        return torch.sparse_csr_tensor(
            torch.as_tensor(matrix.indptr.astype(np.int64)),
            torch.as_tensor(matrix.indices.astype(np.int64)),
            torch.as_tensor(matrix.data.astype(np.float32)),
            matrix.shape,
            device=device,
            check_invariants=False,
        )


class LargeSteps:
    """M of one mesh, factorised once, in double precision. Edge and smoothing lengths are one number or one a vertex.

    The factor lies in host memory (docs/adr/0006-no-gpl-by-default.md): with tensors on a GPU every solve copies its
    right-hand side to the host and the solution back.
    """

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        vertex_count: int,
        *,
        edge_length_m: float | Float[np.ndarray, "V"],
        smoothing_m: float | Float[np.ndarray, "V"],
        device: torch.device,
    ):
        strength = np.broadcast_to(np.square(np.divide(smoothing_m, edge_length_m)) / 1.5, vertex_count)
        matrix = identity(vertex_count) + combinatorial_laplacian(triangles, vertex_count, strength)
        self._matrix = to_torch(matrix.tocsr(), device)
        # M is symmetric and diagonally dominant: no pivoting, so that rows keep the columns' fill-reducing order.
        self._factor = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def latent(self, displacement: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """u = M d."""
        return self._matrix @ displacement

    def displacement(self, latent: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """d = M^-1 u; differentiable."""
        return _Solve.apply(latent, self._factor)


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, right: Tensor, factor: SuperLU) -> Tensor:
        ctx.factor = factor
        return _solve(factor, right)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        # M is symmetric, so its adjoint is the same solve.
        return _solve(ctx.factor, grad_outputs[0]), None


def _solve(factor: SuperLU, right: Tensor) -> Tensor:
    """The solution in the right-hand side's type and on its device."""
    # NumPy converts: for so few numbers PyTorch would start its threads, which costs more than the solve.
    host = right.detach().cpu().numpy()
    solution = factor.solve(host.astype(np.float64))
    return torch.from_numpy(np.ascontiguousarray(solution, dtype=host.dtype)).to(right.device)
