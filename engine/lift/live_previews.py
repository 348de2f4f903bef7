"""Draws pictures of the points before training, and of the model during it, from a camera that the user chooses. They
take a limited share of the time, draw no random numbers and do not influence training."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import PlgsError
from ..job import EventWriter, LiftFolder, write_atomically
from ..job.cameras import PreviewCamera, read_preview_request
from ..model.render import render_view
from ..model.structured import StructuredScene
from ..passes.baked_view import ShownInstances
from ..passes.layers import decide
from ..passes.previews import Picture, colour_picture, panoptic_picture
from ..scene import Camera, ClassTable, Frame, Scene, size_within
from ..scene.pixels import image_bytes
from ..semantics.point_cloud import SemanticPointCloud

log = logging.getLogger("plgs.lift")

EVERY_S = 2.0
"""Minimum seconds between two previews."""
LARGEST_SHARE = 0.05
"""The largest share of the time for previews, which sets the pause after each (not after the first, which may
compile)."""
LONGEST_S, WATCHED_S = 15.0, 5.0
"""Maximum seconds between two previews, whatever share of the time they take: without and with a requested camera."""
OUTSIDE = 1.0
"""A requested camera farther than this, in metres, from all cameras of the scene counts as outside the room."""
MOST_POINTS, NEIGHBOURS = 30_000, 12
"""The most surface points that get a normal, and the number of a point's neighbours that its normal is fitted to."""
NO_INSTANCES = ShownInstances({})
SIZE_WITHIN = (480, 480)
"""The largest width and height of a preview in pixels."""


class LivePreviews:
    """Replaces result/previews/live.png (``folder.live_preview_path``) every few seconds, and reports it. If
    preview.json, where the user names a camera, cannot be used, it warns once and shows a held-out frame."""

    def __init__(
        self,
        folder: LiftFolder,
        scene: Scene,
        events: EventWriter,
        instances: ShownInstances = NO_INSTANCES,
        clock: Callable[[], float] = time.monotonic,
        surface: NDArray[np.float32] | None = None,
    ) -> None:
        """``surface``: points float32 [N, 3], metres, which tell front from back. ``instances`` may be set later."""
        self.folder, self.scene, self.instances, self.events = folder, scene, instances, events
        self._clock, self._due, self._is_first = clock, clock(), True
        self._last_read: tuple[int, int, int] | None = None  # the stamp of preview.json when it was last read
        self._camera, self._fingerprint = frame_to_show(scene).camera, ""
        self._has_warned = False
        self._eyes = np.array([frame.camera.centre for frame in scene.frames])
        self.surface = surface
        self._fronts: tuple[cKDTree, NDArray[np.float64]] | None = None

    def __call__(self, lifted: StructuredScene) -> None:
        """Render the model ``lifted`` to the preview file if a preview is due. Raises OSError if the disk is full."""
        began = self._clock()
        if began < self._due:
            return
        self._draw(lifted)
        ended = self._clock()
        pause = 0.0 if self._is_first else (ended - began) * (1 - LARGEST_SHARE) / LARGEST_SHARE
        took = ended - began
        longest = WATCHED_S if self._fingerprint else LONGEST_S
        self._due = ended + max(EVERY_S, min(pause, max(longest - took, took)))  # at most half of the time
        self._is_first = False

    def show_points(self, cloud: SemanticPointCloud, owner: NDArray[np.int32]) -> None:
        """Draw the cloud's points; ``owner`` int32 [N]: each point's instance. Raises OSError if the disk is full."""
        camera, self.surface = self._wanted_camera(), cloud.xyz
        wanted = self._facing(cloud.xyz, camera.centre)
        self._write(*points_picture(cloud, owner, wanted, camera, self.scene.classes))

    def clear_away(self) -> None:
        """Delete the preview, which is not part of the result. Raises PermissionError if it stays open for 2 s."""
        for pause_s in (0.1, 0.4, 1.5):
            try:
                return self.folder.live_preview_path.unlink(missing_ok=True)
            except PermissionError:  # on Windows, while Blender reads it
                time.sleep(pause_s)
        self.folder.live_preview_path.unlink(missing_ok=True)

    def _draw(self, lifted: StructuredScene) -> None:
        camera = self._wanted_camera()
        rendering = render_view(self._without_backs(lifted, camera.centre), camera)
        layers = decide(rendering, self.scene.classes, self.instances.class_of)
        photo, colours = colour_picture(layers), self.instances.colours
        picture = panoptic_picture(layers.semantic, layers.instance, photo, self.scene.classes, colours)
        self._write(picture, rendering.alpha)

    def _write(self, picture: Picture, alpha: NDArray[np.floating]) -> None:
        if self._fingerprint:  # drawn over what Blender shows
            picture = np.dstack([picture, np.rint(255 * np.clip((alpha - 0.3) / 0.4, 0, 1)).astype(np.uint8)])
        try:
            write_atomically(self.folder.live_preview_path, image_bytes(picture))
        except PermissionError as error:  # on Windows, while a program reads the last one
            log.info("a live preview was skipped: %s", error)
        else:
            self.events.preview(self.folder.live_preview_path, self._fingerprint)

    def _without_backs(self, lifted: StructuredScene, eye: NDArray[np.float64]) -> StructuredScene:
        faces = self._facing(lifted.anchors.position.numpy(force=True), eye)
        if faces.all():
            return lifted
        rows = torch.from_numpy(np.flatnonzero(faces)).to(lifted.anchors.position.device)
        finest = None if lifted.finest is None else lifted.finest[rows]
        return replace(lifted, anchors=lifted.anchors.select(rows), finest=finest)

    def _facing(self, xyz: NDArray[np.float32], eye: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points ``xyz`` [N, 3] to draw, bool [N]. If a requested camera at ``eye`` is outside the room,
        points that face away from it are left out, so that one sees into the room; otherwise all are drawn."""
        is_outside = np.linalg.norm(self._eyes - eye, axis=1).min() > OUTSIDE
        if self.surface is None or not self._fingerprint or not is_outside:
            return np.ones(len(xyz), np.bool_)
        if self._fronts is None:
            self._fronts = fronts_of(self.surface, self._eyes)
        tree, normals = self._fronts
        return np.asarray(np.einsum("ij,ij->i", normals[tree.query(xyz)[1]], eye - xyz) >= 0.0)

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
        """Return the camera to draw from and its fingerprint: that of a requested camera, "" for a frame."""
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


def points_picture(
    cloud: SemanticPointCloud, owner: NDArray[np.int32], wanted: NDArray[np.bool_], camera: Camera, classes: ClassTable
) -> tuple[Picture, NDArray[np.float32]]:
    """Draw the points where ``wanted`` bool [N] as discs that touch, near over far; ``owner`` int32 [N]: their
    instances. Return the picture of colours, classes and instances, and alpha float32 [H, W], 1 on a disc, else 0."""
    of_point = np.flatnonzero(wanted)
    row, pixel, depth = camera.seen(cloud.xyz[of_point])
    shown = np.zeros((camera.height, camera.width), np.int32)  # 0 = none, else the number of a point from 1
    radius, order = np.ceil(cloud.spacing * camera.fx / depth), np.argsort(-depth, kind="stable")
    discs = np.column_stack([pixel, np.minimum(radius, camera.width), of_point[row] + 1]).astype(np.int64)
    for x, y, size, number in discs[order].tolist():
        cv2.circle(shown, (x, y), size, number, cv2.FILLED)
    semantic, instance = (np.append(np.int32(0), ids)[shown] for ids in (cloud.class_id, owner))
    photo = np.concatenate([np.zeros((1, 3), np.uint8), cloud.rgb])[shown]
    return panoptic_picture(semantic, instance, photo, classes, {}), (shown > 0).astype(np.float32)


def fronts_of(surface: NDArray[np.float32], eyes: NDArray[np.float64]) -> tuple[cKDTree, NDArray[np.float64]]:
    """Return a k-d tree of up to MOST_POINTS of the ``surface``'s points [N, 3], and their normals, float64 [n, 3]: of
    the plane through each point's neighbours, turned towards the nearest camera centre in ``eyes`` [V, 3]."""
    xyz = surface[:: 1 + len(surface) // MOST_POINTS].astype(np.float64)
    tree = cKDTree(xyz)
    around = xyz[tree.query(xyz, min(NEIGHBOURS, len(xyz)))[1]].reshape(len(xyz), -1, 3)
    around -= around.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][..., 0]
    towards = eyes[cKDTree(eyes).query(xyz)[1]] - xyz
    return tree, np.where(np.einsum("ij,ij->i", normal, towards)[:, None] < 0.0, -normal, normal)


def frame_to_show(scene: Scene) -> Frame:
    """Return the frame to preview by default: the middle one of the held-out frames or, if there are none, of all."""
    frames = scene.test_frames or scene.frames
    return frames[len(frames) // 2]
