"""Which Mitsuba variant runs: LLVM on the CPU or CUDA, chosen once per process."""

from typing import Literal

import torch

Variant = Literal["llvm", "cuda"]


def activate(variant: Variant = "llvm", *, deterministic: bool = False) -> torch.device:
    """Select the variant and return the torch device whose memory it shares.

    With `deterministic`, sums run in one fixed order: one thread on the CPU, which costs about half the speed
    of two cores; on CUDA atomics stay unordered, so bit-for-bit equality is a promise of the CPU alone.

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
    if deterministic:
        dr.set_thread_count(1)
        torch.set_num_threads(1)
        torch.use_deterministic_algorithms(True)
    return torch.device("cuda" if variant == "cuda" else "cpu")
