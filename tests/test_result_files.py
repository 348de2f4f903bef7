"""instances.json, semantic_points.npz and anchors.npz: what was written is what is read, and twice the same bytes."""

import json
from pathlib import Path

import numpy as np
import pytest

from engine.result_files import (
    Anchors,
    Instance,
    MatchedSegment,
    SemanticPoints,
    read_arrays,
    read_instances,
    write_arrays,
    write_instances,
)
from tests.passes.views import CLASSES
from tests.raises_key import raises_key

RANDOM = np.random.default_rng(5)


def test_result_arrays_are_read_back_and_written_reproducibly(tmp_path: Path) -> None:
    rgb = RANDOM.integers(0, 256, (9, 3), dtype=np.uint8)
    points = SemanticPoints(RANDOM.normal(size=(9, 3)), rgb, np.arange(9), np.arange(9) * 2, RANDOM.uniform(size=9))
    for name in "ab":
        write_arrays(tmp_path / f"{name}.npz", points)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    read = read_arrays(tmp_path / "a.npz", SemanticPoints)
    assert {name: array.dtype.str for name, array in vars(read).items()} == {
        "xyz": "<f4", "rgb": "|u1", "class_id": "<i4", "instance_id": "<i4", "confidence": "<f4",
    }  # fmt: skip
    for name, array in vars(points).items():
        np.testing.assert_allclose(getattr(read, name), array, rtol=1e-6)
    with raises_key("no-array"):
        read_arrays(tmp_path / "a.npz", Anchors)
    points.__dict__["xyz"] = points.xyz[1:]
    with pytest.raises(ValueError, match="differ in length"):
        write_arrays(tmp_path / "c.npz", points)


OUTLINE = "0.000,0.100 0.500,0.100 0.500,0.600;0.700,0.700 0.800,0.700 0.800,0.800"


def made_instance(number: int) -> Instance:
    return Instance(
        id=number,
        name=f"chair {number}",
        class_id=5,
        class_name="chair",
        colour=(1, 2, 3),
        centre=(0.0, 1.0, 2.0),
        size=(1.0, 1.0, 1.0),
        yaw=0.5,
        rotation=(1.0, 0.0, 0.0, 0.0),
        views=3,
        score=0.9,
        points=100,
        segments=(MatchedSegment("0001", 17, 5, 0.8, None, 0.75, 1200, 0.25, (0.0, 0.1, 0.5, 0.6), OUTLINE),),
    )


def test_instances_are_read_back_in_the_order_of_their_ids(tmp_path: Path) -> None:
    path = tmp_path / "instances.json"
    write_instances(path, CLASSES, [made_instance(2), made_instance(1)])
    assert read_instances(path) == (CLASSES, (made_instance(1), made_instance(2)))
    with pytest.raises(ValueError, match="unique"):
        write_instances(path, CLASSES, [made_instance(1), made_instance(1)])


def test_bad_mask_outlines_in_results_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "instances.json"
    for outline in ("0.1,0.2", "0.100,0.200,", "0.100,0.200 " * 3, 7, ["0.100,0.200"], "9.000,0.000"):
        write_instances(path, CLASSES, [made_instance(1)])
        content = json.loads(path.read_text())
        content["instances"][0]["segments"][0]["outline"] = outline
        path.write_text(json.dumps(content))
        with raises_key("instances-damaged"):
            read_instances(path)
