"""COLMAP's incremental mapping of photos, step by step, so that it can be followed and stopped."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..errors import lacks_part
from ..job import EventWriter, StopSignal

STAGE = "poses"
_ALL_PAIRS = 200
"""Photos up to which every one is compared with every other. More are compared with those near in their order."""
_NEAR = 20
_POLL_S = 0.1


def colmap(photos: Path) -> Any:
    """The package pycolmap. Raises PlgsError where it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise lacks_part("poses of photos are made with the package pycolmap", photos, "colmap") from error
    return pycolmap


def map_photos(photos: Path, names: Sequence[str], workplace: Path, events: EventWriter, stop: StopSignal) -> Any:
    """The largest reconstruction of photos that one camera took (pycolmap's Reconstruction); None when there is none.

    The same photos give the same poses, except for what threads change. Raises PlgsError without pycolmap; Cancelled.
    """
    pycolmap = colmap(photos)
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(0)
    database, token = workplace / "photos.db", pycolmap.CancellationToken()
    lens = pycolmap.ImageReaderOptions()
    lens.camera_model = "SIMPLE_RADIAL"

    def step(number: int, label: str, work: Callable[[], Any]) -> Any:
        events.stage(STAGE, number, 4, label)
        return _followed(work, token, stop)

    step(2, "Looking for features", lambda: pycolmap.extract_features(
        database, photos, image_names=list(names), camera_mode=pycolmap.CameraMode.SINGLE, reader_options=lens,
        cancellation_token=token,
    ))  # fmt: skip
    if len(names) <= _ALL_PAIRS:
        match = lambda: pycolmap.match_exhaustive(database, cancellation_token=token)  # noqa: E731
    else:
        near = pycolmap.SequentialPairingOptions(overlap=_NEAR)
        match = lambda: pycolmap.match_sequential(  # noqa: E731
            database, pairing_options=near, cancellation_token=token
        )
    step(3, "Comparing photos", match)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0)
    registered = 0

    def told() -> None:
        nonlocal registered
        registered = min(registered + 1, len(names))
        events.progress(STAGE, registered, len(names))

    found = step(4, "Finding poses", lambda: pycolmap.incremental_mapping(
        database, photos, workplace, options=options, next_image_callback=told, cancellation_token=token,
    ))  # fmt: skip
    return max(found.values(), key=lambda model: model.num_reg_images(), default=None)


def _followed(work: Callable[[], Any], token: Any, stop: StopSignal) -> Any:
    """The result of ``work``, done in its own thread until it is stopped. Raises what ``work`` raises; Cancelled."""
    answers: list[Any] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            answers.append(work())
        except BaseException as error:  # handed on to the caller below
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            stop.check()
            time.sleep(_POLL_S)
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if errors:
        raise errors[0]
    return answers[0]
