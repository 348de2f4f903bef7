"""A finished lift of the tiny room, made from its ground truth. Held-out views have passes, numbered with gaps."""

import json
import struct
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from plgs.engine.job import LiftFolder, LiftRequest, write_manifest
from plgs.engine.posed.names import murmur3, name_bits
from plgs.engine.scene import Frame, Scene, open_scene
from plgs.engine.scene_of_lift import remember_scene

from tests.tiny_scene import (
    CABINET,
    CABINET_ID,
    CATEGORIES,
    CHAIR,
    CHAIR_ID,
    tiny_intrinsics,
    trace_view,
    write_tiny_scene,
)

FRAMES = 14
"""Of which two are held out."""
CHAIR_NAME, CABINET_NAME = "chair 1", "cabinet 1"
_BOXES = [(1, CHAIR_NAME, CHAIR_ID, CHAIR), (2, CABINET_NAME, CABINET_ID, CABINET)]


def write_tiny_lift(
    folder: Path,
    scene: Path | None = None,
    frames: int = FRAMES,
    *,
    size: tuple[int, int] = (64, 48),
    instances: int = 2,
    bake: bool = True,
) -> LiftFolder:
    """Write the scene (unless one is given) beside the lift, and the lift as if it had just finished."""
    scene = scene or write_tiny_scene(folder.parent / "tiny room", frames=frames, size=size)
    lift = LiftFolder.create(folder, LiftRequest(scene=scene.absolute()))
    opened = open_scene(scene)
    remember_scene(lift, opened)
    lift.previews_path.mkdir(parents=True)
    _write_points(lift.result_path, opened, size)
    _write_instances(lift.result_path / "instances.json", instances, opened, size)
    if bake:
        lift.passes_path.mkdir()
        for frame in opened.test_frames:
            write_passes(lift.passes_path / f"{frame.name}.exr", frame, frame.size)
    write_manifest(lift.result_path, versions={}, seed=0, settings={}, timings={})
    return lift


def write_passes(path: Path, frame: Frame, size: tuple[int, int], overscan: int = 0, guessed: int = 0) -> None:
    """The passes of one view as `engine.passes` names its layers, with so many pixels around the picture. Where the
    instance ``guessed`` is, what is shown counts as guessed."""
    view = trace_view(frame.camera.camera_to_world, tiny_intrinsics(size), size)
    colour = (view.colour / 255.0) ** 2.2
    channels = {f"PLGS.Combined.{c}": colour[..., i] for i, c in enumerate("RGB")}
    channels |= {"PLGS.Combined.A": np.ones_like(view.depth), "PLGS.Depth.V": view.depth}
    channels |= {"PLGS.Semantic.V": view.semantic, "PLGS.Instance.V": view.instance}
    channels |= {"PLGS.Confidence.V": np.full(view.depth.shape, 0.9), "PLGS.Entropy.V": np.full(view.depth.shape, 0.1)}
    position = frame.camera.resized(*size).unproject(view.depth)
    channels |= {f"PLGS.Position.{axis}": position[..., i] for i, axis in enumerate("XYZ")}
    channels |= {f"PLGS.Normal.{axis}": np.full(view.depth.shape, i == 2) for i, axis in enumerate("XYZ")}
    if guessed:
        channels["PLGS.Guessed.V"] = view.instance == guessed
    header: dict[str, object] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    first, last = np.array([-overscan] * 2, np.int32), np.array(size, np.int32) - 1 - overscan
    header |= {"dataWindow": (first, last), "displayWindow": (np.zeros(2, np.int32), last - overscan)}
    layers = {
        "CryptoInstance": (view.instance, {number: name for number, name, _, _ in _BOXES}),
        "CryptoClass": (view.semantic, {int(str(each["id"])): str(each["name"]) for each in CATEGORIES}),
    }
    for layer, (ids, names) in layers.items():
        table = np.zeros(256, np.float32)
        for number, name in names.items():
            table[number] = _float_hash(name)
        ranks = {"r": table[ids], "g": (ids > 0), "b": np.zeros_like(ids), "a": np.zeros_like(ids)}
        channels |= {f"{layer}00.{c}": plane for c, plane in ranks.items()}
        prefix = f"cryptomatte/{murmur3(layer.encode()):08x}"[:19] + "/"
        manifest = {name: struct.pack(">f", _float_hash(name)).hex() for name in names.values()}
        header |= {prefix + "name": layer, prefix + "hash": "MurmurHash3_32"}
        header |= {prefix + "conversion": "uint32_to_float32", prefix + "manifest": json.dumps(manifest)}
    planes = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))


def _write_points(result: Path, scene: Scene, size: tuple[int, int]) -> None:
    xyz, rgb, class_id, instance_id = [], [], [], []
    for frame in scene.frames:
        view = trace_view(frame.camera.camera_to_world, tiny_intrinsics(size), size)
        xyz.append(frame.camera.resized(*size).unproject(view.depth).reshape(-1, 3))
        rgb.append(view.colour.reshape(-1, 3))
        class_id.append(view.semantic.ravel())
        instance_id.append(view.instance.ravel())
    points: dict[str, NDArray[np.generic]] = {
        "xyz": np.concatenate(xyz).astype(np.float32),
        "rgb": np.concatenate(rgb),
        "class_id": np.concatenate(class_id).astype(np.int32),
        "instance_id": np.concatenate(instance_id).astype(np.int32),
    }
    count = len(points["xyz"])
    np.savez(result / "semantic_points.npz", **points, confidence=np.linspace(0.0, 1.0, count, dtype=np.float32))
    anchors = {name: values[::20] for name, values in points.items()}
    few = len(anchors["xyz"])
    level, opacity = np.arange(few, dtype=np.int32) % 4, np.linspace(0.0, 1.0, few, dtype=np.float32)
    np.savez(result / "anchors.npz", **anchors, level=level, opacity=opacity)


def _write_instances(path: Path, count: int, scene: Scene, size: tuple[int, int]) -> None:
    entries = []
    for number, name, class_id, (low, high) in _BOXES[:count]:
        category = next(each for each in CATEGORIES if each["id"] == class_id)
        entries.append(
            {
                "id": number, "name": name, "class_id": class_id, "class_name": category["name"],
                "colour": [250, 180, 20] if number == 1 else [20, 190, 220],
                "centre": ((low + high) / 2.0).tolist(), "size": (high - low).tolist(),
                "yaw": 0.0, "rotation": [1.0, 0.0, 0.0, 0.0],
                "views": 7, "score": 0.875, "points": 1234, "segments": _masks_of(number, class_id, scene, size),
            }
        )  # fmt: skip
    classes = [
        {"id": each["id"], "name": each["name"], "is_thing": bool(each["isthing"]), "colour": each["color"]}
        for each in CATEGORIES
    ]
    path.write_text(json.dumps({"format": 1, "up": "z", "classes": classes, "instances": entries}))


def _masks_of(number: int, class_id: int, scene: Scene, size: tuple[int, int]) -> list[dict[str, object]]:
    """The exact masks of an instance in the frames that a lift learns from."""
    masks: list[dict[str, object]] = []
    width, height = size
    for frame in scene.train_frames:
        seen = trace_view(frame.camera.camera_to_world, tiny_intrinsics(size), size).instance == number
        if seen.any():
            rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
            masks.append(
                {
                    "frame": frame.name, "segment_id": 10 + number, "class_id": class_id, "score": 0.875,
                    "cost": None, "agreement": 0.75, "pixels": int(seen.sum()), "share": float(seen.mean()),
                    "rectangle": [float(columns[0]) / width, float(rows[0]) / height,
                                  float(columns[-1] + 1) / width, float(rows[-1] + 1) / height],
                }
            )  # fmt: skip
    return masks


def _float_hash(name: str) -> float:
    return struct.unpack(">f", struct.pack(">I", name_bits(name)))[0]


def mend_manifest(lift: Path) -> None:
    """As if what was changed since had been so from the beginning."""
    (lift / "result" / "manifest.json").unlink()
    write_manifest(lift / "result", versions={}, seed=0, settings={}, timings={})
