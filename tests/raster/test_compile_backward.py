"""The backward pass is compiled as the passes will call it."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import random_scene, render

from engine.raster import compile_backward
from engine.raster.kernels import choose_kernels


@pytest.mark.parametrize("name", ["vector", "plain"])
def test_compiles_what_a_pass_calls(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another version of a kernel, for arrays of another type, would be compiled in the midst of a pass."""
    monkeypatch.setenv("PLGS_RASTER_KERNELS", name)
    kernels = choose_kernels()
    compile_backward.compile_backward(kernels)
    scene = random_scene(0, 30, 4, 20, 16)
    render(scene, "numba")
    for kernel in (kernels.unblend, kernels.gather):
        assert len(kernel.signatures) == 1  # type: ignore[attr-defined]
    assert np.isfinite(render(scene, "numba")[0].image.detach().numpy()).all()
