"""Which Mitsuba variant runs: LLVM on the CPU or CUDA, chosen once per process."""

from typing import Literal

import torch

Variant = Literal["llvm", "cuda"]


def activate(variant: Variant = "llvm", *, deterministic: bool = False) -> torch.device:
    """Select the variant and return the torch device whose memory it shares.

    Sums over pixels run in a fixed order, so on the CPU two runs were equal bit for bit with any mode; a difference in
    the last bit would grow to tenths of a millimetre within a fit. What is left to chance is the order in which threads
    build the BVH: `deterministic` takes that away too, with one thread, for about twice the time. On CUDA torch's sums
    stay unordered, and equality is no promise.

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
    # What use_deterministic_algorithms does, but for seconds of importing its compiler, which is not used here.
    torch.set_deterministic_debug_mode("warn" if variant == "cuda" else "error")
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    if deterministic:
        torch.set_num_threads(1)
    dr.set_thread_count(torch.get_num_threads())  # OMP_NUM_THREADS is for both: processes side by side share the cores
    return torch.device("cuda" if variant == "cuda" else "cpu")
