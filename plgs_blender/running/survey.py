"""What the panel's scene contains, and what can be done with it. An engine reads the pixels in the background; without
one, only the headers of plain folders are read."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...engine.errors import PlgsError
from ...engine.posed.frames import PosedScene, Size
from .. import registry
from ..chosen_scene import ChosenScene, needs_engine
from ..engine_environment import engine_python
from ..inspecting.drawing import Colour
from ..registry import SceneTask, start_engine
from ..settings import PLGS_PG_settings, chosen_scene

_GIVE = {"depth": "choose depth maps", "masks": "choose or make masks"}


@dataclass(frozen=True)
class Survey:
    """What is known about a scene; nothing while an engine reads it (``is_looking``). ``error`` says why it cannot be
    lifted. ``classes`` are names with sRGB colours, 0..1, and ``things`` the names of those with instances. ``sizes``
    are the sizes of images with their counts. In both, the commonest come first. ``depth_range`` is the nearest, median
    and farthest depth in metres, None if no engine has read the pixels; ``has_masks`` is None then, too.
    ``picture_files`` counts the frames whose picture is a file that Blender can show, ``left_out`` those that a lift
    would not use. ``inferred`` is what no file states, each with whether it is doubtful."""

    chosen: ChosenScene
    train_frames: int = 0
    test_frames: int = 0
    sizes: tuple[tuple[Size, int], ...] = ()
    classes: tuple[tuple[str, Colour], ...] = ()
    things: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    error: PlgsError | None = None
    depth_range: tuple[float, float, float] | None = None
    is_looking: bool = False
    format: str = ""
    has_depth: bool = False
    has_masks: bool | None = False
    sparse_points: int = 0
    picture_files: int = 0
    inferred: tuple[tuple[str, bool], ...] = ()
    left_out: int = 0

    @property
    def frames(self) -> int:
        return self.train_frames + self.test_frames


class SceneLook(SceneTask):
    """A task in which an engine reads a scene's pixels."""

    kind, label = "survey", "Looking at the frames"

    def done(self, scene: Any) -> None:
        global _latest
        if self.has_finished or self.error is not None:
            _latest = _with_answer(Survey(self.chosen), self.answer, self.error)


_latest: Survey | None = None


def survey_of(chosen: ChosenScene) -> Survey | None:
    """Return what is known about this scene; None if it was never read."""
    return _latest if _latest is not None and _latest.chosen == chosen else None


def survey_of_panel(settings: PLGS_PG_settings) -> Survey | None:
    """Return what is known about the panel's scene, None if it was never read."""
    return survey_of(chosen_scene(settings)) if settings.scene_folder else None


def look(chosen: ChosenScene, python: Path | None) -> Survey:
    """Let an engine read the scene if there is a ``python`` for one; else read plain folders now, 1 ms per frame."""
    global _latest
    registry.forget(SceneLook.kind)
    _latest = Survey(chosen)
    if python is not None:
        with suppress(PlgsError, OSError):  # the engine's status says what is wrong with that Python
            registry.begin(SceneLook(chosen, start_engine("inspect", python, *chosen.arguments())))
            _latest = Survey(chosen, is_looking=True)
            return _latest
    try:
        _latest = _look_alone(chosen)
    except PlgsError as error:
        _latest = Survey(chosen, error=error)
    return _latest or Survey(chosen)


def _look_alone(chosen: ChosenScene) -> Survey | None:
    """Return what Blender sees without engine; None if one is needed and usable. Raises PlgsError if none is usable."""
    for path in (chosen.scene, chosen.masks, chosen.depth):
        if path is not None and not os.path.exists(path):
            raise PlgsError("file-missing", "there is no such file or folder", path, "Choose another one.")
    if chosen.is_plain:
        return _of_plain(chosen, chosen.open_plain())
    if engine_python() is None:
        raise needs_engine(chosen)
    return None


def _of_plain(chosen: ChosenScene, scene: PosedScene) -> Survey:
    held_out = sum(frame.held_out for frame in scene.frames)
    return Survey(
        chosen,
        train_frames=len(scene.frames) - held_out,
        test_frames=held_out,
        sizes=tuple(Counter(frame.size for frame in scene.frames).most_common()),
        warnings=scene.warnings,
        format=scene.format,
        has_depth=all(frame.depth_path is not None for frame in scene.frames),
        has_masks=None,
        picture_files=len(scene.frames),
    )


def _with_answer(survey: Survey, answer: Mapping[str, Any] | None, error: PlgsError | None) -> Survey:
    """Return the survey with the answer of `engine inspect`, or its error."""
    if error is not None or answer is None:
        unknown = PlgsError("bad-answer", "the engine did not answer", survey.chosen.scene, "Read the scene again.")
        return replace(survey, error=error or unknown)
    try:
        depth_range = answer["depth_range"]
        if depth_range is not None:
            near, middle, far = (float(each) for each in depth_range)
            depth_range = (near, middle, far)
        return replace(
            survey,
            train_frames=int(answer["train_frames"]),
            test_frames=int(answer["test_frames"]),
            sizes=tuple(((int(width), int(height)), int(count)) for (width, height), count in answer["colour_sizes"]),
            classes=tuple(
                (str(each["name"]), _colour(each["colour"]))
                for each in sorted(answer["classes"], key=lambda each: -float(each["share"]))
            ),
            things=tuple(str(each["name"]) for each in answer["classes"] if each["is_thing"]),
            warnings=tuple(str(each) for each in answer["warnings"]),
            depth_range=depth_range,
            format=str(answer["format"]),
            has_depth=_is_of_all(answer, "depth_sizes"),
            has_masks=_is_of_all(answer, "mask_sizes"),
            sparse_points=int(answer["sparse_points"]),
            picture_files=int(answer["picture_files"]),
            inferred=tuple(
                (f"{str(each['about']).capitalize()}: {each['taken']}: {each['reason']}", bool(each["is_doubtful"]))
                for each in answer["inferred"]
            ),
            left_out=sum(int(each["count"]) for each in answer["left_out"]),
        )
    except (ValueError, TypeError, KeyError) as fault:
        what = f"the engine's answer about the scene cannot be read ({fault!r})"
        return replace(survey, error=PlgsError("bad-answer", what, survey.chosen.scene, "Read it again."))


def _colour(colour: Sequence[int]) -> Colour:
    red, green, blue = (channel / 255.0 for channel in colour)
    return red, green, blue


def _is_of_all(answer: Mapping[str, Any], sizes: str) -> bool:
    """Whether the frames counted in ``answer[sizes]`` (pairs of a size and its count) are all frames of the scene."""
    count = sum(int(count) for _, count in answer[sizes])
    return count == int(answer["train_frames"]) + int(answer["test_frames"])


def obstacles_to(survey: Survey, has_engine: bool) -> dict[str, str | None]:
    """Return why a readable scene cannot give each key (Cameras, Pictures, Coloured cloud, Lift); None if it can."""
    has_pictures = survey.picture_files == survey.frames or has_engine
    has_cloud = survey.sparse_points > 0 or (survey.has_depth and has_engine)
    no_cloud = "the engine makes it from the depth: set it up" if survey.has_depth else "there are no depth maps"
    return {
        "Cameras": None,
        "Pictures": None if has_pictures else "they are in a video or an archive, or distorted: set up the engine",
        "Coloured cloud": None if has_cloud else no_cloud,
        "Lift": why_not_liftable(survey),
    }


def why_not_liftable(survey: Survey) -> str | None:
    """Return why a scene without an error cannot be lifted; None if it can or is not known yet."""
    has = {"depth": survey.has_depth, "masks": survey.has_masks}
    lacks = [what for what in has if has[what] is False]
    if not lacks or survey.is_looking or survey.error is not None:
        return None
    return f"no {' and no '.join(lacks)}; {' and '.join(_GIVE[what] for what in lacks)} below"
