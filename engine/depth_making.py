"""Make depth for the photos of a scene that has none, with a network. It is written to ``made_depth`` in the scene's
folder, which every later command reads (`engine/scene/made.py`). Each photo's map is written at once, so that a stopped
run can continue; all of them are then fitted to the reconstruction's points and to each other
(`engine/depth_agreement.py`), and ``made_by.json`` is written last."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .depth_agreement import Map, agreeing_depth
from .errors import PlgsError
from .job import write_atomically
from .job.own_files import OwnFiles
from .known_networks import licence_of
from .networks import load_weights, loading, model_folder, quiet_transformers, refuse_nan
from .posed.array_file import read_npy
from .posed.layout import listed
from .scene import Scene, digests_of_files, size_within
from .scene.depth import only_depth
from .scene.estimated_depth import LEAST_POINTS, seen_points
from .scene.made import DEPTH_FOLDER, MADE_BY, MadeDepth, layout_of, scale_of

_RAW = "raw"  # the folder of the network's own maps, until all are made
_LONGEST = 640  # pixels of the longer side of a map
_AGAIN = "Move the folder made_depth away, then make it again."
Follow = Callable[[int, int], object]
"""Called with the number of frames done and of all. Its errors end the work."""


@dataclass(frozen=True)
class DepthNetwork:
    """A loaded depth network: the ``name`` that was given to load it, and ``look``, which returns a map float32 [h, w]
    for a picture uint8 [H, W, 3] RGB."""

    name: str
    look: Callable[[NDArray[np.uint8]], NDArray[np.float32]]


def load_depth_network(name: str, *, download: bool) -> DepthNetwork:
    """Load the network in the folder ``name``, or of this name on the Hugging Face hub (any of transformers' class
    AutoModelForDepthEstimation). It is fetched only with ``download``. Raises PlgsError if it cannot be loaded."""
    quiet_transformers(name, download, "segment", "depth is made")
    import transformers

    folder = model_folder(name, download=download)
    with loading(name):  # with pillow, as torchvision is not there
        limits: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False, "backend": "pil"}
        processor = transformers.AutoImageProcessor.from_pretrained(folder, **limits)
    network = load_weights(transformers.AutoModelForDepthEstimation, folder, name)
    return DepthNetwork(name, partial(_map_of, name, network, processor))


def _map_of(name: str, network: Any, processor: Any, colour: NDArray[np.uint8]) -> NDArray[np.float32]:
    import torch

    with torch.inference_mode(), loading(name, runs=True):
        inputs = processor(images=colour, return_tensors="pt", input_data_format="channels_last")
        found = network(pixel_values=inputs["pixel_values"]).predicted_depth
        width, height = size_within((colour.shape[1], colour.shape[0]), (_LONGEST, _LONGEST))
        whole = torch.nn.functional.interpolate(found[:, None].float(), size=(height, width), mode="bilinear")
    refuse_nan(whole, name)
    return np.asarray(whole[0, 0].numpy(), np.float32)


def make_depth(scene: Scene, folder: Path, network: DepthNetwork, follow: Follow) -> list[str]:
    """Make the depth of every frame below ``folder``, continuing an earlier run; returns warnings. ``follow`` is called
    with (done, total). Raises PlgsError for depth of another network or of other photos, or few points; OSError."""
    place, scale = folder / DEPTH_FOLDER, scale_of(folder)  # stored in the poses' own unit
    names = [frame.name for frame in scene.frames]
    photos = dict(zip(names, digests_of_files([(frame.colour_path,) for frame in scene.frames]), strict=True))
    about = {
        "model": network.name, **licence_of(network.name), "frames": len(scene.frames), "photos": photos,
        "layout": layout_of({frame.name: frame.camera for frame in scene.frames}, scale),
    }  # fmt: skip
    if (known := MadeDepth.read(folder)) is not None:
        if known.model != network.name or not photos.items() <= known.photos.items():
            raise PlgsError("other-depth", "there is depth by another network, or of other photos", place, _AGAIN)
        return []
    points = scene.points
    if points is None or not len(points):
        what = "a network's depth has no unit, and there are no points of a reconstruction to fit it to"
        raise PlgsError("no-points", what, scene.folder, "Find the poses with COLMAP, or give a mesh with --depth.")
    seen = {frame.name: seen_points(frame, points) for frame in scene.frames}
    own = OwnFiles(place).begin("depth", {name: about[name] for name in ("model", "photos")})
    maps, few = dict[str, Map](), list[str]()
    total = len(scene.frames)
    with own:
        for done, frame in enumerate(scene.frames, start=1):
            path, (places, depths) = place / _RAW / f"{frame.name}.npy", seen[frame.name]
            if len(depths) < LEAST_POINTS:
                few.append(frame.name)
                continue
            if not own.owns(path):
                write_atomically(path, partial(_save, network.look(frame.read_colour(None))))
            maps[frame.name] = Map(frame.camera, partial(_read_map, path), places, depths)
            follow(done, 2 * total)
        if not maps:
            what = f"none of the {total} frames sees the {LEAST_POINTS} points that fitting depth needs"
            raise PlgsError("few-points", what, scene.folder, "Take more photos, or give a mesh with --depth.")
        lost = []
        for name, depth in agreeing_depth(maps, lambda done, all_: follow(total + done * total // all_, 2 * total)):
            if depth is None:
                lost.append(name)
            else:
                write_atomically(place / f"{name}.npy", partial(_save, only_depth(depth / np.float32(scale))))
        if len(lost) == len(maps):
            own.discard()  # so that another network can be tried
            what = "no depth map of this network follows the reconstruction's points"
            raise PlgsError("depth-unrelated", what, place, "Name another network with --model.")
        write_atomically(place / MADE_BY, json.dumps(about) + "\n")
        for name in maps:
            own.remove(place / _RAW / f"{name}.npy")
    own.complete()
    told = ((few, f"see fewer than {LEAST_POINTS} points"), (lost, "have maps that fit no points"))
    return [f"{len(names)} frames {why}, and get no depth: {listed(names)}" for names, why in told if names]


def is_made(folder: Path) -> bool:
    """Whether the depth of a scene with its files in ``folder`` is complete."""
    return (folder / DEPTH_FOLDER / MADE_BY).is_file()


def _save(values: NDArray[Any], part: Any) -> None:
    np.save(part, values)


def _read_map(path: Path) -> NDArray[np.float32]:
    return read_npy(path, _AGAIN).astype(np.float32)
