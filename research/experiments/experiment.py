"""An experiment, its scenes, and the lifts that it needs: which row on which scene, where, by which options."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from engine.batch.plan import of_scene
from engine.errors import PlgsError
from engine.presets.options import shown_options
from engine.scene_source import UP_OPTIONS, SceneSource, UpAxis

from ..results import Result
from .rows import Row, Rows
from .table import Tables

PROGRAM = "research"
"""The program that lifts, as it knows the options of the baselines."""
SHARED = ("preset", "steps", "frames", "fit", "scene_format", "mask_format", "classes", "device")
"""Options of the command ``lift`` that are the same for all lifts of an experiment."""
FIRST = "ours"
"""The row whose lift is the preset itself: its folder's name contains no row."""


# The scenes that a command line names: ``SCENE`` or ``SCENE:up=y``.

_SCENE = re.compile(r"(?P<folder>.+?)(?::up=(?P<up>.*))?", re.DOTALL)
_NAME = re.compile(r"\w[\w .+-]*")
"""A name becomes part of a folder's name, and a cell of a Markdown table."""


@dataclass(frozen=True)
class SceneToLift:
    """A scene's folder (absolute), the upward axis of its poses, and its name in the tables."""

    name: str
    folder: Path
    up: UpAxis = "z"


def scenes_from(texts: Sequence[str], names: Sequence[str] | None = None) -> tuple[SceneToLift, ...]:
    """Return the scenes of ``texts``, each ``SCENE`` or ``SCENE:up=AXIS``, with ``names``, or else named like their
    folders. Raises PlgsError if an axis or a name is invalid, if two names are the same, or if there are more or fewer
    names than scenes."""
    if names is not None and len(names) != len(texts):
        what = f"{len(names)} names for {len(texts)} scenes"
        raise PlgsError("unequal-counts", what, ",".join(names), "Give one name per scene.")
    scenes = [_scene(text) for text in texts]
    if names is not None:
        scenes = [SceneToLift(name, scene.folder, scene.up) for name, scene in zip(names, scenes, strict=True)]
    known: set[str] = set()
    for scene in scenes:
        if not _NAME.fullmatch(scene.name):
            fix = "Give names with --names, of letters, digits and hyphens."
            raise PlgsError("scene-unnamable", f"{scene.name!r} is not a valid scene name", scene.folder, fix)
        if scene.name.casefold() in known:  # on some disks Office and office are the same folder
            what = f"two scenes are called {scene.name}"
            raise PlgsError("names-clash", what, scene.folder, "Give other names with --names.")
        known.add(scene.name.casefold())
    return tuple(scenes)


def _scene(text: str) -> SceneToLift:
    match = _SCENE.fullmatch(text)
    if match is None:
        raise PlgsError("not-scene", "is not a scene", repr(text), "Give the scene's folder.")
    up = match["up"] if match["up"] is not None else "auto"
    if up not in UP_OPTIONS:
        fix = f"Write SCENE:up= and one of {', '.join(UP_OPTIONS)}."
        raise PlgsError("not-axis", f"{up!r} is not an up axis", text, fix)
    folder = Path(match["folder"]).resolve()
    return SceneToLift(folder.name, folder, UP_OPTIONS[up])


@dataclass(frozen=True)
class Experiment:
    """Rows of the tables, on ``scenes``, lifted into ``folder``. ``only`` names the rows and tables to lift; () means
    all. All lifts start from ``preset`` (a name, or a file) and each of ``seeds``, with ``steps`` and the options
    ``sets`` (name=value); all scenes are read by ``scene_format``, ``mask_format`` and ``classes``, from at most
    ``frames``, with ``fit`` and ``device``, as in a LiftRequest. ``masks`` and ``depth`` are paths in which {scene}
    stands for the scene's name. ``only_finished``: nothing more is lifted."""

    scenes: tuple[SceneToLift, ...]
    folder: Path
    rows: Rows
    only: tuple[str, ...] = ()
    preset: str = "preview"
    steps: int | None = None
    sets: tuple[str, ...] = ()
    scene_format: str | None = None
    mask_format: str | None = None
    classes: str | None = None
    masks: Path | None = None
    depth: Path | None = None
    frames: int | None = None
    fit: bool | None = None
    device: str | None = None
    seeds: tuple[int, ...] = (0,)
    only_finished: bool = False

    @property
    def preset_name(self) -> str:
        return Path(self.preset).stem

    def masks_of(self, scene: SceneToLift, masks: str | None = None) -> Path | None:
        """Return where a scene's masks are: at the path ``masks`` in its folder, else where --masks says, else None,
        which means in the scene itself."""
        return scene.folder / masks if masks else of_scene(self.masks, scene.name)

    def source(self, scene: SceneToLift, masks: str | None = None) -> SceneSource:
        """Return a scene and how this experiment reads it. ``masks`` is as in `masks_of`."""
        return SceneSource(
            scene.folder, self.masks_of(scene, masks), scene.up, self.scene_format,
            of_scene(self.depth, scene.name), self.mask_format, self.classes,
        )  # fmt: skip

    def tables(self, results: tuple[Result, ...] = ()) -> Tables:
        return Tables(self.rows, self.rows.chosen(self.only), results)


@dataclass(frozen=True)
class Task:
    """One row on one scene with one seed. ``options`` are those of the command ``lift``; ``depth_of`` is the folder of
    the lift whose rendered depth it uses."""

    scene: SceneToLift
    row: Row
    seed: int
    options: argparse.Namespace
    depth_of: Path | None = None

    @property
    def name(self) -> str:
        seed = f", seed {self.seed}" if self.seed else ""
        return f"{self.scene.name}: {self.row.name}{seed}"


def tasks_of(experiment: Experiment) -> Iterator[Task]:
    """Yield the lifts that the chosen rows need, row by row, except those whose scene lacks the row's files."""
    wanted = [experiment.rows.lift_of(row) for row in experiment.rows.chosen(experiment.only)]
    wanted += [experiment.rows.named(row.depth_from) for row in wanted if row.depth_from]
    for row in dict.fromkeys(row.name for row in experiment.rows.rows if row in wanted and row.is_lift):
        for scene in experiment.scenes:
            for seed in experiment.seeds:
                own = experiment.rows.named(row)
                if has_files(own, scene):
                    source = experiment.rows.named(own.depth_from) if own.depth_from else None
                    depth_of = None if source is None else lift_folder(experiment, scene, source, seed)
                    yield Task(scene, own, seed, lift_options(experiment, scene, own, seed), depth_of)


def has_files(row: Row, scene: SceneToLift) -> bool:
    """Whether a scene has the files that a row uses instead of the usual ones."""
    return row.masks is None or (scene.folder / row.masks).exists()


def lift_folder(experiment: Experiment, scene: SceneToLift, row: Row, seed: int) -> Path:
    """Return the folder into which a row is lifted."""
    parts = [scene.name, experiment.preset_name, "" if row.name == FIRST else row.slug, f"seed{seed}" if seed else ""]
    return experiment.folder / "-".join(part for part in parts if part)


def lift_options(experiment: Experiment, scene: SceneToLift, row: Row, seed: int) -> argparse.Namespace:
    """Return the options of ``lift SCENE -o FOLDER/SCENE-PRESET-ROW --bake none --resume``."""
    output = lift_folder(experiment, scene, row, seed)
    return argparse.Namespace(
        **{name: getattr(experiment, name) for name in SHARED},
        program=PROGRAM,
        scene=scene.folder,
        output=output,
        set=[*experiment.sets, *shown_options(row.options)],  # the later one wins, so that a row's own options hold
        size=None,
        seed=seed,
        masks=experiment.masks_of(scene, row.masks),
        detections=None,
        up=scene.up,
        depth=output.with_name(f"{output.name}-maps") if row.depth_from else of_scene(experiment.depth, scene.name),
        names_from=None,
        anyway=None,
        poses=None,
        bake="none",
        resume=True,
    )


def has_manifest(lift: Path) -> bool:
    return (lift / "result" / "manifest.json").is_file()
