"""After the warm-up, a lift compiles nothing."""

from __future__ import annotations

import gc
from pathlib import Path

from numba.core.dispatcher import Dispatcher

from engine.lift import warm_up
from engine.model.render import render_bands
from engine.passes.baked_view import ShownInstances, bake_view
from tests.train.tiny_lift import TINY, colour_error, trainer_of, views_of


def compiled() -> dict[str, int]:
    """How many machine code versions each of the engine's kernels has in this process."""
    kernels = [each for each in gc.get_objects() if issubclass(type(each), Dispatcher)]  # asks nothing of the others
    ours = [kernel for kernel in kernels if kernel.__module__.startswith("engine.")]
    return {f"{kernel.__module__}.{kernel.__name__}": len(kernel.signatures) for kernel in ours}


def test_nothing_is_left_to_compile(tmp_path: Path) -> None:
    warm_up()
    before = compiled()
    assert len(before) > 10 and sum(before.values()) > 10
    views, classes = views_of(tmp_path / "scene")
    trainer = trainer_of(views, classes, TINY, tmp_path)
    while not trainer.finished:
        trainer.step()
    colour_error(views, trainer)
    for owned in (None, {1: 5}):
        camera = views[0].camera
        for most_bytes in (None, 1):  # whole, and in bands
            bands = render_bands(trainer.scene, camera, most_bytes=most_bytes)
            bake_view(bands, camera, classes, ShownInstances({}, owned))
    assert compiled() == before
