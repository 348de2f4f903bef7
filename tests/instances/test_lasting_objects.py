"""Objects of two lifts are one where their points overlap."""

import numpy as np

from engine.instances.lasting_objects import LastingObjects, lasting_objects, object_overlap


def block(corner: tuple[float, float, float], size: tuple[float, float, float], step: float) -> np.ndarray:
    """A box full of points, float64 [N, 3] metres."""
    axes = [np.arange(low, low + side, step) for low, side in zip(corner, size, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def cloud(step: float, *boxes: tuple[int, tuple[float, float, float], tuple[float, float, float]]) -> tuple:
    """Points and the objects that own them: (id, corner, size)."""
    parts = [block(corner, size, step) for _, corner, size in boxes]
    ids = np.repeat([number for number, *_ in boxes], [len(part) for part in parts])
    return np.concatenate(parts), ids.astype(np.int32)


CHAIR, TABLE, LAMP = (0.5, 0.5, 0.9), (1.4, 0.8, 0.7), (0.3, 0.3, 0.4)


def found(old: tuple, new: tuple) -> LastingObjects:
    return lasting_objects(object_overlap(*old, *new))


def test_objects_of_two_lifts_match_despite_other_ids_and_point_spacing() -> None:
    old = cloud(0.02, (1, (0, 0, 0), CHAIR), (2, (3, 0, 0), CHAIR), (5, (1, 2, 0), TABLE), (0, (5, 5, 0), CHAIR))
    near = ((9, (1, 2.03, 0), TABLE), (1, (3, 0, 0.02), CHAIR), (3, (0, 0.02, 0), CHAIR))
    new = cloud(0.035, *near, (4, (5, 5, 0), LAMP))
    assert found(old, new) == LastingObjects({9: 5, 1: 2, 3: 1}, {}, {})


def test_matching_two_lifts_reports_split_and_merged_objects() -> None:
    whole = cloud(0.03, (1, (0, 0, 0), TABLE))
    halves = cloud(0.03, (1, (0, 0, 0), (0.9, 0.8, 0.7)), (2, (0.9, 0, 0), (0.5, 0.8, 0.7)))
    assert found(whole, halves) == LastingObjects({1: 1}, {2: 1}, {})
    assert found(halves, whole) == LastingObjects({1: 1}, {}, {2: 1})


def test_lifts_without_objects_match_nothing() -> None:
    some, none = cloud(0.03, (1, (0, 0, 0), LAMP)), (np.zeros((0, 3)), np.zeros(0, np.int32))
    assert found(some, none) == found(none, some) == found(none, none) == LastingObjects({}, {}, {})
