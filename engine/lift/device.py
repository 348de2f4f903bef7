"""Where a lift draws its Gaussians: on the CPU, or on a CUDA device with gsplat."""

from __future__ import annotations

import torch

from ..errors import PlgsError
from ..raster.cuda import what_fails, what_is_missing


def refuse_missing_device(device: str) -> None:
    """Raise PlgsError, before any work, if ``device`` is "cuda" and nothing can be drawn there."""
    if device != "cuda":
        return
    where, on_cpu = "--device cuda", "or lift with --device cpu."
    if not torch.cuda.is_available():
        fix = f"Use a machine with a CUDA device and a build of torch for CUDA, {on_cpu}"
        raise PlgsError("torch finds no CUDA device here", where, fix, option="--device")
    missing = what_is_missing()
    if missing is not None:
        raise PlgsError(missing, where, f"Do that, {on_cpu}", option="--device")
    fails = what_fails(device)
    if fails is not None:
        find_out = 'python -c "from gsplat.cuda import _backend"'
        fix = f"It needs the nvcc of torch's CUDA, ninja and a C++ compiler; {find_out} tells more. Mend that, {on_cpu}"
        raise PlgsError(f"gsplat cannot draw here ({fails})", where, fix, option="--device")


def be_repeatable(device: str = "cpu") -> None:
    """Make the same input give the same bits. On a CUDA device torch only warns about what it cannot repeat."""
    # torch.use_deterministic_algorithms also configures torch's compiler, which takes 3 s to import.
    torch.set_deterministic_debug_mode("warn" if device == "cuda" else "error")
