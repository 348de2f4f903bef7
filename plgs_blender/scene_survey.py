"""What is in the scene's folder, as an engine finds out meanwhile; where there is none, what the headers say.

The panel draws from here; nothing is read while it draws.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..engine.job import ExitCode, JobError
from ..engine.job.process import EngineProcess, engine_call
from ..engine.job.scene_source import SceneSource
from ..engine.scene import Scene, SceneError, Size, UpAxis, open_asked
from .paths import absolute
from .scene_formats import AUTOMATIC, chosen_format


@dataclass(frozen=True)
class Place(SceneSource):
    """Which scene, by absolute paths as the user typed them."""

    @classmethod
    def of(
        cls, folder: str, masks: str, up: UpAxis, scene_format: str = AUTOMATIC, depth: str = "",
        mask_format: str = AUTOMATIC, classes: str = "",
    ) -> Place:  # fmt: skip
        """From paths as users type them; no masks, no depth maps and no classes are empty texts."""
        masks_path, depth_path = (absolute(path) if path else None for path in (masks, depth))
        return cls(
            absolute(folder), masks_path, up, chosen_format(scene_format), depth_path, chosen_format(mask_format),
            classes_of(classes),
        )  # fmt: skip

    def open(self) -> Scene:
        """Open it, headers only. Raises SceneError."""
        try:
            return open_asked(self)
        except ImportError as error:
            fix = "Set the engine up, which can, and import again."
            raise SceneError("Blender's Python alone cannot look into this video", self.scene, fix) from error

    def arguments(self) -> list[str | Path]:
        """How the engine's commands are told it."""
        told: list[str | Path] = [self.scene, f"--up={self.up}"]
        given = {"--masks": self.masks, "--format": self.scene_format, "--depth": self.depth}
        named = {"--mask-format": self.mask_format, "--classes": self.classes}
        for option, value in (given | named).items():
            told += [] if value is None else [option, value]
        return told


def classes_of(text: str) -> str | None:
    """The table of classes that a user names: the absolute path of a .toml file, or a table's name; None for none."""
    return str(absolute(text)) if text.endswith(".toml") else text or None


def lacks_package(error: SceneError) -> bool:
    """Whether Blender's Python could not read a scene that an engine's Python may."""
    return isinstance(error.__cause__, ImportError)


@dataclass(frozen=True)
class Survey:
    """What is known of a scene. ``error`` and ``fix`` say why it cannot be lifted; None and empty when it can.

    ``sizes`` of the colour images with how many have each, the commonest first; ``depth_range`` the nearest, middle and
    farthest depth in metres, None where no engine has looked into the pixels. ``picture_files`` counts the frames whose
    picture is an image file as it is: those that Blender can show by itself. While an engine looks (``is_looking``),
    nothing else is known.
    """

    place: Place
    train_frames: int = 0
    test_frames: int = 0
    sizes: tuple[tuple[Size, int], ...] = ()
    classes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    error: str | None = None
    fix: str = ""
    depth_range: tuple[float, float, float] | None = None
    is_looking: bool = False
    format: str = ""
    has_depth: bool = False
    has_masks: bool = False
    sparse_points: int = 0
    picture_files: int = 0

    @property
    def frames(self) -> int:
        return self.train_frames + self.test_frames


_latest: Survey | None = None
_inspector: EngineProcess | None = None


def survey_of(place: Place) -> Survey | None:
    """What is known of this scene; None when nobody has looked yet."""
    return _latest if _latest is not None and _latest.place == place else None


def look(place: Place, python: Path | None) -> Survey:
    """Let an engine look at the scene if there is a ``python`` for one; else read its headers now, 1 ms a frame.

    Never raises for a bad scene: the survey says what is wrong.
    """
    global _latest
    stop_looking()
    _latest = Survey(place)
    if python is None or not _begin_inspection(place, python):
        try:
            _latest = _from_headers(place, place.open())
        except SceneError as error:
            _latest = Survey(place, error=f"{error.what}: {error.where}", fix=error.fix)
        except (OSError, ValueError) as error:  # a path that this system cannot even look at
            _latest = Survey(place, error=f"the scene cannot be looked at ({error})", fix="Choose other folders.")
    return _latest


def is_looking() -> bool:
    """Whether an engine looks into the pixels just now."""
    return _inspector is not None


def poll() -> bool:
    """Take the engine's answer, when it is there; whether it goes on looking."""
    global _latest, _inspector
    if _inspector is None or _latest is None:
        return False
    code = _inspector.exit_code()
    if code is None:
        return True
    output = _inspector.output_tail()
    stop_looking()
    _latest = _with_answer(replace(_latest, is_looking=False), code, output)
    return False


def stop_looking() -> None:
    """End an inspection that is still going on."""
    global _inspector
    if _inspector is not None:
        _inspector.kill()
        _inspector.close()
        _inspector = None


def _begin_inspection(place: Place, python: Path) -> bool:
    """Whether an engine could be started."""
    global _latest, _inspector
    command = [*engine_call(python), "inspect", *place.arguments(), "--json", "--stay-with-parent"]
    try:
        _inspector = EngineProcess(command)
    except JobError:  # what is wrong with that Python, its own status says
        return False
    _latest = Survey(place, is_looking=True)
    return True


def _from_headers(place: Place, scene: Scene) -> Survey:
    sizes = Counter(frame.size for frame in scene.frames).most_common()
    return Survey(
        place,
        train_frames=len(scene.train_frames),
        test_frames=len(scene.test_frames),
        sizes=tuple(sizes),
        classes=tuple(category.name for category in scene.classes.categories),
        warnings=scene.warnings,
        format=scene.format,
        has_depth=scene.has_depth,
        has_masks=scene.has_masks,
        sparse_points=0 if scene.points is None else len(scene.points),
        picture_files=sum(frame.file_shows_colour for frame in scene.frames),
    )


def _with_answer(survey: Survey, code: int, output: str) -> Survey:
    """The survey with what `engine inspect --json` said; its error line when the scene is bad."""
    line = output.splitlines()[-1] if output else "no answer"
    if code == ExitCode.BAD_INPUT and line.startswith("error: "):
        return replace(survey, error=line.removeprefix("error: "))
    try:
        answer: dict[str, Any] = json.loads(line)
        depth_range = answer["depth_range"]
        if depth_range is not None:
            near, middle, far = (float(each) for each in depth_range)
            depth_range = (near, middle, far)
        return replace(
            survey,
            train_frames=int(answer["train_frames"]),
            test_frames=int(answer["test_frames"]),
            sizes=tuple(((int(width), int(height)), int(count)) for (width, height), count in answer["colour_sizes"]),
            classes=tuple(str(each["name"]) for each in answer["classes"]),
            warnings=tuple(str(each) for each in answer["warnings"]),
            depth_range=depth_range,
            format=str(answer["format"]),
            has_depth=_of_all(answer, "depth_sizes"),
            has_masks=_of_all(answer, "mask_sizes"),
            sparse_points=int(answer["sparse_points"]),
            picture_files=int(answer["picture_files"]),
        )
    except (ValueError, TypeError, KeyError) as error:
        return replace(survey, error=f"the engine could not look at it ({error!r}): {line}", fix="Look again.")


def _of_all(answer: dict[str, Any], sizes: str) -> bool:
    """Whether as many frames have it as there are."""
    count = sum(int(count) for _, count in answer[sizes])
    return count == int(answer["train_frames"]) + int(answer["test_frames"])
