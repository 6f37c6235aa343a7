"""The choice of the Mitsuba variant, LLVM on the CPU or CUDA, once per process."""

from typing import Literal

import torch

Variant = Literal["llvm", "cuda"]


def activate(variant: Variant = "llvm", *, deterministic: bool = False) -> torch.device:
    """Set the Mitsuba variant, torch's deterministic mode and the number of threads.

    Sums over pixels have a fixed order, because a difference in the last bit would grow to tenths of a millimetre
    within a fit. On the CPU only the order in which threads build the BVH is left undefined.

    Args:
        variant: `llvm` (CPU) or `cuda`.
        deterministic: use one thread, which also fixes the order of BVH builds, for about twice the time. On CUDA
            torch's sums stay unordered, and results may differ.

    Returns:
        The torch device whose memory the variant shares.

    Raises:
        InputError: no usable libLLVM (`llvm`), or no CUDA device (`cuda`).
    """
    from registration.errors import InputError
    from registration.render import llvm

    if variant == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "No CUDA device",
            where="--variant cuda",
            expected="an NVIDIA GPU that torch can see",
            got="torch.cuda.is_available() is False",
            fix="run with --variant llvm",
        )
    if variant == "llvm":
        llvm.ensure_usable()
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(f"{variant}_ad_rgb")
    # Equals use_deterministic_algorithms, which would import torch's compiler for seconds.
    torch.set_deterministic_debug_mode("warn" if variant == "cuda" else "error")
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    if deterministic:
        torch.set_num_threads(1)
    dr.set_thread_count(torch.get_num_threads())  # OMP_NUM_THREADS holds for both: processes share the cores
    return torch.device("cuda" if variant == "cuda" else "cpu")
