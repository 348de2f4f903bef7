"""Pictures of the model during training, from a camera that the user chooses.

They take a limited share of the time and do not influence training: they draw no random numbers and change no sums.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..job import EventWriter, LiftFolder, write_atomically
from ..job.cameras import PreviewCamera, read_preview_request
from ..model.render import render_view
from ..model.structured import StructuredScene
from ..passes.baked_view import ShownInstances
from ..passes.layers import decide
from ..passes.previews import panoptic_picture
from ..scene import Camera, Frame, Scene, size_within
from ..scene.pixels import image_bytes

log = logging.getLogger("plgs.lift")

EVERY_S = 2.0
"""Minimum seconds between two previews."""
LARGEST_SHARE = 0.05
"""The largest share of the time for previews, which sets the pause after each. The first is exempt: it may compile."""
LONGEST_S = 15.0
"""Maximum seconds from one preview to the next, whatever share of the time they take."""
SIZE_WITHIN = (480, 480)
"""The largest width and height of a preview in pixels."""


class LivePreviews:
    """Writes result/previews/live.png (``folder.live_preview_path``) every few seconds, by rename, and reports it. The
    first problem with preview.json gives a warning, and a held-out frame is shown instead."""

    def __init__(
        self,
        folder: LiftFolder,
        scene: Scene,
        instances: ShownInstances,
        events: EventWriter,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder, self.scene, self.instances, self.events = folder, scene, instances, events
        self._clock, self._due, self._is_first = clock, clock(), True
        self._last_read: tuple[int, int, int] | None = None  # the stamp of preview.json when it was last read
        self._camera, self._fingerprint = frame_to_show(scene).camera, ""
        self._has_warned = False

    def __call__(self, lifted: StructuredScene) -> None:
        """Draw the model if a preview is due. Raises OSError if the disk is full."""
        began = self._clock()
        if began < self._due:
            return
        self._draw(lifted)
        ended = self._clock()
        pause = 0.0 if self._is_first else (ended - began) * (1 - LARGEST_SHARE) / LARGEST_SHARE
        took = ended - began
        self._due = ended + max(EVERY_S, min(pause, max(LONGEST_S - took, took)))  # at most half of the time
        self._is_first = False

    def clear_away(self) -> None:
        """Delete the picture, which does not belong to the result. Raises PermissionError if it stays open for 2 s."""
        for pause_s in (0.1, 0.4, 1.5):
            try:
                return self.folder.live_preview_path.unlink(missing_ok=True)
            except PermissionError:  # on Windows, while Blender reads it
                time.sleep(pause_s)
        self.folder.live_preview_path.unlink(missing_ok=True)

    def _draw(self, lifted: StructuredScene) -> None:
        rendering = render_view(lifted, self._wanted_camera())
        layers = decide(rendering, self.scene.classes, self.instances.class_of)
        picture = panoptic_picture(layers, self.scene.classes, self.instances.colours)
        try:
            write_atomically(self.folder.live_preview_path, image_bytes(picture))
        except PermissionError as error:  # on Windows, while a program reads the last one
            log.info("a live preview was skipped: %s", error)
        else:
            self.events.preview(self.folder.live_preview_path, self._fingerprint)

    def _wanted_camera(self) -> Camera:
        path = self.folder.preview_request_path
        stamp: tuple[int, int, int] | None = None
        with suppress(OSError):  # no file yet; a new file has another stamp
            found = path.stat()
            stamp = found.st_mtime_ns, found.st_size, found.st_ino
        if stamp != self._last_read:
            self._last_read = stamp
            self._camera, self._fingerprint = self._read_camera(path)
        width, height = size_within((self._camera.width, self._camera.height), SIZE_WITHIN)
        return self._camera.resized(width, height)

    def _read_camera(self, path: Path) -> tuple[Camera, str]:
        """The camera to draw, and the fingerprint of a requested camera ("" for a frame)."""
        default = frame_to_show(self.scene).camera, ""
        try:
            wanted = read_preview_request(path)
            if isinstance(wanted, PreviewCamera):
                (fx, _, cx), (_, fy, cy), _ = wanted.K
                pose = np.array(wanted.camera_to_world)
                return Camera(wanted.width, wanted.height, fx, fy, cx, cy, pose), wanted.fingerprint
            named = [frame.camera for frame in self.scene.frames if frame.name == wanted]
            if wanted is not None and not named:
                what = f"the scene has no frame {wanted!r}"
                raise PlgsError("no-frame", what, path, "Choose another camera for the preview.")
            return (named[0], "") if named else default
        except PlgsError as error:
            log.warning("%s", error)
            if not self._has_warned:
                self._has_warned = True
                self.events.warning(f"the previews show a different camera from the requested one: {error}")
            return default


def frame_to_show(scene: Scene) -> Frame:
    """The middle one of the held-out frames, which are not trained on, or of all frames if none is held out."""
    frames = scene.test_frames or scene.frames
    return frames[len(frames) // 2]
