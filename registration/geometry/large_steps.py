"""Large steps [Nicolet 2021]: smooth displacements by a preconditioner; and the Laplacians of a mesh.

The variable is u = M d with M = I + lambda L, L the combinatorial Laplacian; d = M^-1 u and dLoss/du = M^-1 dLoss/dd.
On a regular triangulation of edge length h this smooths over l = h sqrt(1.5 lambda). Lambda may vary from edge to edge,
so that l does not depend on the edge length, or varies as required.
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
    """Compute the mean length of each vertex' edges, in the points' unit; for isolated vertices the median of all."""
    adjacency = _adjacency(triangles, len(points)).tocoo()
    length = np.linalg.norm(points[adjacency.row].astype(np.float64) - points[adjacency.col], axis=1)
    count = np.bincount(adjacency.row, minlength=len(points))
    total = np.bincount(adjacency.row, weights=length, minlength=len(points))
    return np.where(count > 0, total / np.maximum(count, 1), np.median(length))


def combinatorial_laplacian(
    triangles: Int[np.ndarray, "F 3"], vertex_count: int, strength: Float[np.ndarray, "V"] | None = None
) -> csr_matrix:
    """Build the Laplacian D - A, (V, V), whose rows sum to zero.

    Args:
        triangles: vertex indices.
        vertex_count: V.
        strength: of the vertices; an edge has the mean of its ends as its weight. None: ones.
    """
    adjacency = _adjacency(triangles, vertex_count)
    if strength is not None:
        scaled = diags(strength)
        adjacency = (scaled @ adjacency + adjacency @ scaled) / 2
    return (diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsr()


def normalised_laplacian(triangles: Int[np.ndarray, "F 3"], vertex_count: int) -> csr_matrix:
    """Build D^-1 (D - A), (V, V): a vertex minus the mean of its neighbours; empty rows for isolated vertices."""
    adjacency = _adjacency(triangles, vertex_count)
    degree = np.asarray(adjacency.sum(1)).ravel()
    return (diags(1 / np.maximum(degree, 1)) @ (diags(degree) - adjacency)).tocsr()


def _adjacency(triangles: Int[np.ndarray, "F 3"], vertex_count: int) -> csr_matrix:
    start = np.concatenate([triangles[:, k] for k in range(3)])
    end = np.concatenate([triangles[:, (k + 1) % 3] for k in range(3)])
    one_way = coo_matrix((np.ones(len(start)), (start, end)), (vertex_count, vertex_count)).tocsr()
    return ((one_way + one_way.T) > 0).astype(np.float64)


def to_torch(matrix: csr_matrix, device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """Copy a SciPy sparse matrix into a PyTorch one in CSR format, for products that carry gradients."""
    matrix = matrix.tocsr()
    with warnings.catch_warnings():
        # A product is 30 times as fast as in COO format, which would not warn.
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
        return torch.sparse_csr_tensor(
            torch.as_tensor(matrix.indptr.astype(np.int64)),
            torch.as_tensor(matrix.indices.astype(np.int64)),
            torch.as_tensor(matrix.data),
            matrix.shape,
            dtype=dtype,
            device=device,
            check_invariants=False,
        )


class LargeSteps:
    """M of one mesh, factorized once, in float64.

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
        """Factorize M.

        Args:
            triangles: vertex indices.
            vertex_count: V.
            edge_length_m: one number, or one for each vertex.
            smoothing_m: the length l over which displacements are smoothed; one number, or one for each vertex.
            device: of the displacements.
        """
        strength = np.broadcast_to(np.square(np.divide(smoothing_m, edge_length_m)) / 1.5, vertex_count)
        matrix = identity(vertex_count) + combinatorial_laplacian(triangles, vertex_count, strength)
        self._matrix = to_torch(matrix.tocsr(), device)
        # M is symmetric and diagonally dominant: no pivoting, so that rows keep the columns' fill-reducing order.
        self._factor = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def latent(self, displacement: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """Compute the latent u = M d of a displacement d."""
        return self._matrix @ displacement

    def displacement(self, latent: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """Compute the displacement d = M^-1 u of a latent u; differentiable."""
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
