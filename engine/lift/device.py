"""Where a lift trains and draws: on the CPU, or on a CUDA device with gsplat."""

from __future__ import annotations

import sys

import torch

from ..errors import PlgsError
from ..job.progress import StageReporter
from ..raster.cuda import what_fails, what_is_missing


def usable_device(device: str, stages: StageReporter) -> str:
    """Return the device for a lift: "cuda" if ``device`` asks for it and it works, otherwise "cpu". "auto" also gives
    "cpu", since no version of ours has run on a GPU yet; a warning says so. For "cuda" the stage "check" draws a test
    picture. gsplat may compile its code for it; *Cancel* then ends the process, and the next try starts over. Raises
    PlgsError if a requested "cuda" does not work."""
    if device == "auto":
        found = torch.cuda.is_available()
        why = "--device cuda is experimental, never run by us on a GPU" if found else "torch finds no CUDA device here"
        stages.events.warning(f"this lift runs on the CPU: {why}")
        return "cpu"
    if device == "cuda":
        _refuse_missing("--device cuda", stages)
    return device


def _refuse_missing(where: str, stages: StageReporter) -> None:
    """Raise PlgsError, about the request ``where``, unless a test picture can be drawn on the CUDA device."""
    on_cpu = "or lift with --device cpu."
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
        fails = what_fails("cuda")
    if fails is not None:
        find_out = f'{sys.executable} -c "from gsplat.cuda import _backend"'
        needs = "gsplat needs nvcc of the CUDA that torch is built for, ninja and a C++ compiler"
        fix = f"{needs}. Run {find_out} for details and install what is missing, {on_cpu}"
        raise PlgsError("gsplat-fails", f"gsplat cannot draw here ({fails})", where, fix, option="--device")


def be_repeatable(device: str = "cpu") -> None:
    """Make torch give the same bits for the same input on the CPU. On a CUDA device its deterministic operators stay
    off: they are slower, and gsplat's sums differ from run to run anyway."""
    # torch.use_deterministic_algorithms also configures torch's compiler, which takes 3 s to import.
    torch.set_deterministic_debug_mode("default" if device == "cuda" else "error")
    # A tenth of the time would go into memory that nothing reads before it is written.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # set by the module's class
    torch.backends.cudnn.allow_tf32 = False  # SSIM's differences of moments would drown in its rounding
