"""Where a lift draws its Gaussians: on the CPU, or on a CUDA device with gsplat."""

from __future__ import annotations

import sys

import torch

from ..errors import PlgsError
from ..raster.cuda import what_fails, what_is_missing
from ..train.progress import StageReporter


def refuse_missing_device(device: str, stages: StageReporter) -> None:
    """Raise PlgsError, before any work, if ``device`` is "cuda" and nothing can be drawn there.

    Drawing is tried within the stage "check". Where gsplat compiles its code for that, *Cancel* ends the process, and
    the next try begins anew.
    """
    if device != "cuda":
        return
    where, on_cpu = "--device cuda", "or lift with --device cpu."
    if not torch.backends.cuda.is_built():
        fix = f"Make an engine with set-up FOLDER --torch cuda (Torch in the preferences' Set-Up Options), {on_cpu}"
        raise PlgsError("cpu-torch", "the engine's torch is a build for CPUs", where, fix, option="--device")
    if not torch.cuda.is_available():
        fix = f"Use a machine with a CUDA device and its driver, {on_cpu}"
        raise PlgsError("no-cuda", "torch finds no CUDA device here", where, fix, option="--device")
    missing = what_is_missing()
    if missing is not None:
        raise PlgsError("gsplat-missing", missing, where, f"Do that, {on_cpu}", option="--device")
    with stages.stage("check", "Trying gsplat (compiles once)"):
        fails = what_fails(device)
    if fails is not None:
        find_out = f'{sys.executable} -c "from gsplat.cuda import _backend"'
        needs = "gsplat needs nvcc of the CUDA that torch is built for, ninja and a C++ compiler"
        fix = f"{needs}; {find_out} tells more. Mend that, {on_cpu}"
        raise PlgsError("gsplat-fails", f"gsplat cannot draw here ({fails})", where, fix, option="--device")


def be_repeatable(device: str = "cpu") -> None:
    """Make the same input give the same bits. On a CUDA device torch only warns about what it cannot repeat."""
    # torch.use_deterministic_algorithms also configures torch's compiler, which takes 3 s to import.
    torch.set_deterministic_debug_mode("warn" if device == "cuda" else "error")
