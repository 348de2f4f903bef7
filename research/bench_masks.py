"""The command ``python -m research bench masks``: measure what a change of the voting rules gains, over many pairs of a
scene and masks of it. ``FOLDER/SCENE/scene`` is a scene with ground truth; every other ``FOLDER/SCENE/MASKS`` holds
masks of it, and perhaps ``detections.json`` to lay over them. Labelled points are compared with the truth at the
held-out frames' own depth, so nothing is trained."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.ndimage import distance_transform_edt

from engine.errors import PlgsError
from engine.job import EventWriter, StopSignal
from engine.job.progress import StageProgress
from engine.json_file import read_object
from engine.lift.objects import MATCHERS, Matching, ViewsToMatch
from engine.lift.preparation import filled_views, semantic_cloud, used_classes
from engine.metrics.panoptic import PanopticEvaluation
from engine.presets.preset import Preset
from engine.scene import Scene, load_view, open_scene_to_lift, size_within
from engine.scene_source import SceneSource
from engine.semantics.cloud_index import LabelledPoints

from .results import number

STORED = Path(__file__).with_name("masks_bench.json")
"""The run of points that rules are compared with (docs/experiments.md)."""
Scores = tuple[float, float]
"""The mean IoU over the true classes, and PQ-scene, in per cent, ``strict``."""
Run = dict[str, Scores]
"""The scores of each pair at each size, by names such as "icl made 200"."""


def pairs_in(folder: Path, only: Sequence[str] = ()) -> dict[str, SceneSource]:
    """The pairs whose name ("SCENE MASKS") contains one of ``only``, by name. Raises PlgsError if there are none."""
    found: dict[str, SceneSource] = {}
    for masks in sorted(each for each in folder.glob("*/*") if each.is_dir() and each.name != "scene"):
        name, over = f"{masks.parent.name} {masks.name}", masks / "detections.json"
        if not only or any(text in name for text in only):
            found[name] = SceneSource(masks.with_name("scene"), masks, detections=over if over.is_file() else None)
    if not found:
        fix = "Give a folder of SCENE/scene and SCENE/MASKS, as docs/experiments.md describes."
        raise PlgsError("no-pairs", "the folder holds no scene with masks", folder, fix)
    return found


def score_points(source: SceneSource, preset: Preset) -> Scores:
    """Match the masks of a pair and score labelled points (`read_points`). Raises PlgsError for bad files."""
    scene = open_scene_to_lift(source)
    with TemporaryDirectory() as name, closing(EventWriter(Path(name, "events.jsonl"))) as events:
        progress = StageProgress("bench", events, StopSignal())
        views = [load_view(frame, size_within(frame.size, preset.size)) for frame in scene.train_frames]
        placed = filled_views(views, Path(name)) if preset.fill_holes else views
        cloud = semantic_cloud(placed, used_classes(views), preset, events, progress)
        given = ViewsToMatch(placed, cloud, scene.classes, scratch=Path(name))
        return read_points(MATCHERS.chosen(preset.objects)(given, preset, progress), scene, preset)


def read_points(matching: Matching, scene: Scene, preset: Preset) -> Scores:
    """Return mIoU and PQ, in per cent, of labelled points: a held-out pixel gets the label of the nearest point."""
    cloud, evaluation = matching.cloud, PanopticEvaluation(scene.classes, "strict")
    points = LabelledPoints(cloud.xyz, np.where(cloud.class_id > 0, np.arange(1, len(cloud) + 1), 0).astype(np.int32))
    class_id, instance = (np.append(0, each) for each in (cloud.class_id, matching.instance_of_point))
    for frame in scene.test_frames:
        if frame.read_ground_truth is not None:
            size = size_within(frame.size, preset.size)
            depth, true = frame.depth(size), frame.read_ground_truth(size)
            row = points.project(frame.camera.resized(*size), depth, np.inf)
            row = row[tuple(distance_transform_edt(depth <= 0, return_distances=False, return_indices=True))]
            evaluation.add(class_id[row], instance[row], true.semantic, true.instance)
    found = evaluation.result()
    return 100 * found.miou_true, 100 * found.pq


def bench_masks(pairs: Mapping[str, SceneSource], preset: Preset, sizes: Sequence[int]) -> Iterator[Run]:
    """Yield a growing Run after each pair of masks and each size: the scores by "SCENE MASKS SIZE"."""
    run: Run = {}
    for name, source in pairs.items():
        for size in sizes:
            run[f"{name} {size}"] = score_points(source, replace(preset, size=(size, size)))
            yield run


def read_run(file: Path) -> Run:
    """Read a stored run. Raises PlgsError if the file holds none."""
    scores = read_object(file, "Give a file that --json wrote.")
    return {key: (number(one[0]) or 0.0, number(one[1]) or 0.0) for key, one in scores.items() if isinstance(one, list)}


def write_run(file: Path, run: Run) -> None:
    lines = (f"{json.dumps(key)}: [{one[0]:.2f}, {one[1]:.2f}]" for key, one in sorted(run.items()))
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def differences(run: Run, before: Run) -> Iterator[str]:
    """Yield the lines of a Markdown table: each pair's mean over its sizes, and what was gained since ``before``, with
    half the range over the sizes; the pair that lost most mIoU comes first. The last line is the mean and its standard
    error."""
    keys: dict[str, list[str]] = {}
    for key in run:
        keys.setdefault(key.rpartition(" ")[0], []).append(key)
    now = {pair: np.array([run[key] for key in own]) for pair, own in keys.items()}
    gain = {
        pair: now[pair] - np.array([before.get(key, (np.nan, np.nan)) for key in own]) for pair, own in keys.items()
    }
    gains = np.array([each.mean(0) for each in gain.values() if not np.isnan(each).any()] or [(np.nan, np.nan)])
    yield "| pair | mIoU / PQ | mIoU gained | PQ gained |\n|---|---|---|---|"
    for pair in sorted(now, key=lambda each: np.nan_to_num(gain[each].mean(0)[0], nan=-np.inf)):
        yield _row(pair, now[pair].mean(0), gain[pair].mean(0), np.ptp(gain[pair], 0) / 2)
    every = np.array([each.mean(0) for each in now.values()]).mean(0)
    yield _row(f"mean of {len(now)}", every, gains.mean(0), gains.std(0) / len(gains) ** 0.5)


def _row(name: str, scores: Sequence[float], gain: Sequence[float], spread: Sequence[float]) -> str:
    cells = ("-" if np.isnan(own) else f"{own:+.1f} ± {off:.1f}" for own, off in zip(gain, spread, strict=True))
    return f"| {name} | {scores[0]:.1f} / {scores[1]:.1f} | {' | '.join(cells)} |"
