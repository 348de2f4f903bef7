"""Whatever is in a lift folder's files: each is read, or refused with one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.command_line.run_engine import run_engine
from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, LiftFolder, LiftRequest, read_cameras, verify
from engine.job.cameras import read_preview_request
from engine.job.recent import recent_lifts, remember_lift
from engine.job.report import metrics_text, read_metrics
from engine.job.terminal import describe
from tests.fuzzing import damaged, examples, with_odd_value
from tests.job.following import watch
from tests.job.lift_folders import tiny_lift

CAMERA = {"name": "shot", "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 32, "cy": 24, "clip": [0.1, 100],
          "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}  # fmt: skip
WALL = {"name": "wall", "iou": 0.5, "tp": 1, "fp": 0, "fn": 2}
TABLE = {"name": "lifted", "mode": "strict", "miou": 0.5, "psnr": 20.0, "depth_error_m": 0.1, "per_class": [WALL]}
METRICS = {"format": 1, "tables": [TABLE]}
JSON_FILES = ["request.json", "result/manifest.json", "result/metrics.json", "checkpoint/state.json", "preview.json",
              "cameras.json", "cache/recent_lifts.json"]  # fmt: skip


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished lift with one of each file, and the user's list beside."""
    request = LiftRequest(scene=Path("/scene"), options={"steps": 7})
    folder = LiftFolder.create(tmp_path_factory.mktemp("fuzz") / "lift", request)
    assert run_engine(folder, lift=tiny_lift) == 0
    folder.checkpoints.save({"step": 1}, lambda into: (into / "model").write_bytes(b"m"))
    (folder.result_path / "metrics.json").write_text(json.dumps(METRICS))
    (folder.path / "preview.json").write_text(json.dumps({**CAMERA, "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]]}))
    (folder.path / "cameras.json").write_text(json.dumps([CAMERA]))
    remember_lift(folder.path, folder.path / "cache")
    writer = EventWriter(folder.events_path)
    writer.hello(threads=1, resumed=True)
    writer.stage("train", 1, 2, "Training")
    writer.progress("train", 1, 2, loss=0.5, eta_s=1.0)
    writer.metric("lifted", {"miou": 0.5})
    writer.preview(folder.live_preview_path, "camera")
    writer.error(PlgsError("broke", "here", "Mend it.", code=ErrorCode.INTERNAL))
    writer.close()
    return folder.path


def look_everywhere(path: Path) -> None:
    """All that reads a lift folder: nothing but PlgsError with one line may come of it."""

    def state() -> None:
        folder = LiftFolder.open(path)
        for look in (folder.state, folder.state_at_a_glance, folder.last_exit_code):
            refused_with_a_line(look)
        for look in (lambda: verify(folder.result_path), folder.checkpoints.latest):
            refused_with_a_line(look)
        refused_with_a_line(lambda: metrics_text(read_metrics(folder), per_class=True).encode())
        follower = watch(folder)
        while follower.is_running:
            follower.poll()
            describe(follower.progress).encode(errors="replace")
        EventWriter(folder.events_path).close()

    refused_with_a_line(state)
    refused_with_a_line(lambda: read_preview_request(path / "preview.json"))
    refused_with_a_line(lambda: read_cameras(path / "cameras.json"))
    recent_lifts(path / "cache")


def refused_with_a_line(look: Callable[[], object]) -> None:
    try:
        look()
    except PlgsError as error:
        assert not {"\n", "\x1b"} & set(str(error)) and error.fix


@examples(60)
@given(data=st.data(), name=st.sampled_from(JSON_FILES))
def test_odd_values_do_no_harm(lift: Path, tmp_path: Path, data: st.DataObject, name: str) -> None:
    content: Any = json.loads((lift / name).read_text())
    for _ in range(data.draw(st.integers(1, 3))):
        content = with_odd_value(data.draw, content)
    with_file(lift, tmp_path, name, json.dumps(content).encode())


@examples(30)
@given(data=st.data(), name=st.sampled_from([*JSON_FILES, "events.jsonl"]))
def test_damaged_bytes_do_no_harm(lift: Path, tmp_path: Path, data: st.DataObject, name: str) -> None:
    with_file(lift, tmp_path, name, damaged(data.draw, (lift / name).read_bytes()))


@examples(40)
@given(data=st.data())
def test_odd_events_do_no_harm(lift: Path, tmp_path: Path, data: st.DataObject) -> None:
    lines = (lift / "events.jsonl").read_text().splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        number = data.draw(st.integers(0, len(lines) - 1))
        lines[number] = json.dumps(with_odd_value(data.draw, json.loads(lines[number])))
    with_file(lift, tmp_path, "events.jsonl", "\n".join([*lines, ""]).encode())


def with_file(lift: Path, tmp_path: Path, name: str, content: bytes) -> None:
    spoilt = tmp_path / "spoilt"
    shutil.rmtree(spoilt, ignore_errors=True)
    shutil.copytree(lift, spoilt)
    (spoilt / name).write_bytes(content)
    look_everywhere(spoilt)
