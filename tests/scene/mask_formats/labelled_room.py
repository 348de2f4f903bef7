"""The frames that every mask format's sample labels, and the one question: are classes and objects those of the room?

``write_frames`` writes the tiny scene without masks; a sample then writes the truth in its format's layout by itself.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.scene import Frame, PanopticMask, Scene
from tests.tiny_scene import CATEGORIES, tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene

NAMES = {category["id"]: str(category["name"]) for category in CATEGORIES}
"""1 wall, 2 floor, 3 cabinet (an object), 5 chair (an object), 13 ceiling."""
THINGS = {"cabinet", "chair"}
COCO_NUMBERS = {1: 131, 2: 122, 3: 120, 5: 56, 13: 118}
"""The room's classes among COCO's 133, counted from 0, where a cabinet is stuff."""
COCO_NAMES = {
    1: "wall-other-merged", 2: "floor-other-merged", 3: "cabinet-merged", 5: "chair", 13: "ceiling-merged"
}  # fmt: skip
SIZE = (64, 48)


@dataclass(frozen=True, eq=False)
class Truth:
    """One frame's classes and objects (0 = none), int32 [H, W] each."""

    name: str
    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]

    def regions(self) -> Iterator[tuple[int, int, NDArray[np.bool_]]]:
        """Class, object and pixels of every region."""
        for class_id in np.unique(self.semantic):
            for number in np.unique(self.instance[self.semantic == class_id]):
                yield int(class_id), int(number), (self.semantic == class_id) & (self.instance == number)


def write_frames(folder: Path, frames: int = 3) -> tuple[Path, list[Truth]]:
    """A scene without masks, and what they should say."""
    write_tiny_scene(folder, frames=frames, size=SIZE, masks="none", ground_truth=False)
    views = [trace_view(tiny_pose(number, frames), tiny_intrinsics(SIZE), SIZE) for number in range(frames)]
    return folder, [Truth(f"{number:04d}", view.semantic, view.instance) for number, view in enumerate(views)]


def write_masked_frames(folder: Path) -> tuple[Path, list[Truth]]:
    """The same with an empty folder for the masks, which is returned."""
    (folder / "masks").mkdir(parents=True)
    return folder / "masks", write_frames(folder)[1]


def mask_of(scene: Scene, place: int = 0) -> PanopticMask:
    return scene.frames[place].mask()


def check_on_room(
    scene: Scene, truths: list[Truth], names: dict[int, str] = NAMES, things: frozenset[str] = frozenset(THINGS)
) -> None:
    """Assert that each pixel shows the class called ``names[true class]`` ("" = void), and that segments of ``things``
    are the true objects, no more and no fewer."""
    assert len(scene.frames) == len(truths)
    for frame, truth in zip(scene.frames, truths, strict=True):
        check_frame(scene, frame, truth, names, things)


def check_frame(scene: Scene, frame: Frame, truth: Truth, names: dict[int, str], things: frozenset[str]) -> None:
    mask = frame.mask()
    of_class = {each.id: each.name for each in scene.classes.categories} | {0: ""}
    shown = np.vectorize(of_class.__getitem__)(mask.class_map())
    wanted = np.vectorize(names.__getitem__)(truth.semantic)
    np.testing.assert_array_equal(shown, wanted)
    assert {of_class[one.class_id] for one in mask.segments if one.is_thing} == things & {*wanted.ravel().tolist()}
    for one in mask.segments:
        assert (mask.ids == one.id).any(), "a segment without pixels"
        if one.is_thing:
            region = mask.ids == one.id
            (number,) = np.unique(truth.instance[region])
            np.testing.assert_array_equal(region, truth.instance == number)


def tracks(scene: Scene, truths: list[Truth]) -> dict[int, set[int | None]]:
    """The tracks that each true object has over all frames."""
    found: dict[int, set[int | None]] = {}
    for frame, truth in zip(scene.frames, truths, strict=True):
        mask = frame.mask()
        for one in mask.segments:
            (number,) = np.unique(truth.instance[mask.ids == one.id])
            if number:
                found.setdefault(int(number), set()).add(one.track)
    return found
