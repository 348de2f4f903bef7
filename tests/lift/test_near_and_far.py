"""A lift is better than its masks where these are right from near and wrong from far.

Of a cabinet with a sink in its top and of a chair there are few near views and many far ones. The far ones do not draw
the sink apart from the cabinet, and take the chair for a second cabinet. With one vote a view (``evidence.masks``
"views", the others "root") the lift shows no sink.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.job import LiftRequest
from tests import tiny_scene
from tests.train.tiny_lift import lift_into, short_warm_start

SIZE = (160, 120)
SINK_ID, SINK = 7, np.array([[2.45, 1.5], [2.8, 1.78]])
NEAR, FAR = 10, 18
HELD_OUT = {"0001", "0010", "0013", "0016", "0019", "0022", "0025"}
"""A near view and six far ones."""
SENSOR_NOISE = 0.015
"""Share of the depth."""


def poses() -> list[np.ndarray]:
    """Half a metre above the cabinet and the chair in turn, and two metres away under the ceiling."""
    tops = [np.array([*box.mean(0)[:2], box[1, 2]]) for box in (tiny_scene.CABINET, tiny_scene.CHAIR)]
    angles = np.linspace(0, 5, NEAR)
    near = [(tops[i % 2], tops[i % 2] + [0.4 * np.cos(a), 0.4 * np.sin(a), 0.6]) for i, a in enumerate(angles)]
    far = [(tops[0], np.array([0.3 + 0.04 * i, 0.3 + 2.4 * (i % 6) / 5, 2.3])) for i in range(FAR)]
    return [tiny_scene.looking_at(target, eye) for target, eye in (*near, *far)]


def with_sink(view: tiny_scene.TinyView, pose: np.ndarray) -> tiny_scene.TinyView:
    """The tiny room with a sink, object 3, in the cabinet's top."""
    camera = tiny_scene.tiny_intrinsics(SIZE)
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5 - camera[0, 2], np.arange(SIZE[1]) + 0.5 - camera[1, 2])
    local = np.stack([x / camera[0, 0], y / camera[1, 1], np.ones_like(x)], -1) * view.depth[..., None]
    points = local @ pose[:3, :3].T + pose[:3, 3]
    inside = ((points[..., :2] > SINK[0]) & (points[..., :2] < SINK[1])).all(-1)
    sink = (view.semantic == tiny_scene.CABINET_ID) & (points[..., 2] > tiny_scene.CABINET[1, 2] - 0.01) & inside
    return replace(
        view,
        colour=np.where(sink[..., None], np.uint8([235, 235, 240]), view.colour),
        semantic=np.where(sink, SINK_ID, view.semantic).astype(np.int32),
        instance=np.where(sink, 3, view.instance).astype(np.int32),
    )


def as_detected(view: tiny_scene.TinyView, number: int) -> tiny_scene.TinyView:
    """From far the sink is part of the cabinet, object 2, and the chair another cabinet."""
    if number < NEAR:
        return view
    return replace(
        view,
        semantic=np.where(
            np.isin(view.semantic, [SINK_ID, tiny_scene.CHAIR_ID]), tiny_scene.CABINET_ID, view.semantic
        ).astype(np.int32),
        instance=np.where(view.semantic == SINK_ID, 2, view.instance).astype(np.int32),
    )


def write_near_and_far(folder: Path) -> Path:
    names = [f"{number:04d}" for number in range(NEAR + FAR)]
    return tiny_scene.write_tiny_scene(
        folder, size=SIZE, poses=poses(), shown=with_sink, seen=as_detected, depth_noise=SENSOR_NOISE,
        categories=[*tiny_scene.CATEGORIES, {"id": SINK_ID, "name": "sink", "isthing": 1, "color": [90, 200, 210]}],
        splits={"train": [name for name in names if name not in HELD_OUT], "test": sorted(HELD_OUT)},
    )  # fmt: skip


def test_a_sink_seen_from_near_is_found_and_scores_beat_the_masks(tmp_path: Path) -> None:
    scene = write_near_and_far(tmp_path / "scene")
    request = LiftRequest(scene=scene, options={"steps": 120, "steps_a_view": 0.0, "size": [120, 90]}, bake="none")
    with short_warm_start(100):
        lift = lift_into(tmp_path / "lift", request)
    found = json.loads((lift.result_path / "metrics.json").read_text())["tables"]
    tables = {table["name"]: table for table in found if table["mode"] == "strict"}
    lifted, masks = tables["lifted"], tables["input masks"]
    sink = next(each for each in lifted["per_class"] if each["class_id"] == SINK_ID)
    assert sink["iou"] > 0.5 and sink["pq"] > 0.5
    assert lifted["miou_true"] > masks["miou_true"] + 0.02 and lifted["pq"] > masks["pq"] + 0.08
