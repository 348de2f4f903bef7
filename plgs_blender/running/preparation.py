"""Engine tasks before a lift: making masks, finding poses, and editing the masks' classes (`scene.plgs_masks`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, IntProperty, StringProperty

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ...engine.job.process import ROOT
from ...engine.scene_source import FILMS as FILMS
from ...engine.scene_source import NUMBERINGS, TABLES
from .. import registry
from ..chosen_scene import ChosenScene, absolute
from ..engine_environment import usable_python
from ..registry import SceneTask, start_engine
from ..settings import chosen_scene
from . import lifting, looking

OWN_TABLE = "OWN"
TABLE_ITEMS = [
    (OWN_TABLE, "The masks' own", "As their files say"),
    *((name, name, f"Start from the classes of {name}") for name in (*TABLES, *NUMBERINGS)),
]


class PLGS_PG_mask_class(bpy.types.PropertyGroup):
    """One class of the masks. `into` names the class that it counts as; "" means itself."""

    label: IntProperty(name="Number", description="Its number in the masks")
    into: StringProperty(name="Counts As",
        description="The class that it is merged into; void drops it; empty leaves it as it is")  # fmt: skip
    is_thing: BoolProperty(name="Thing",
        description="Countable objects, such as chairs; stuff, such as walls, has no instances")  # fmt: skip


KNOWN_MASKS = [
    (each["name"], f"{each['label']}: {each['good_for']}", f"{each['bytes'] / 1e6:.0f} MB; {each['seconds']:.1f} s of "
     f"one thread for a picture; licence of the weights: {each['licence']} ({each['stated']})")
    for each in json.loads((ROOT / "engine" / "known_networks.json").read_text(encoding="utf-8"))["masks"]
]  # fmt: skip


def _take_known(masks: PLGS_PG_masks, context: bpy.types.Context) -> None:
    masks.model = masks.known


class PLGS_PG_masks(bpy.types.PropertyGroup):
    """The list of classes, its file, and the network that makes masks: `scene.plgs_masks`."""

    classes: CollectionProperty(type=PLGS_PG_mask_class)
    active: IntProperty()
    path: StringProperty()
    void: StringProperty()
    model: StringProperty(name="Model",
        description="A folder with a network, or its name on the Hugging Face Hub; empty: the default")  # fmt: skip
    known: EnumProperty(name="Network", items=KNOWN_MASKS, update=_take_known,
        description="Known networks, with their size, the licence of their weights, and seconds a frame")  # fmt: skip


def fill_classes(masks: PLGS_PG_masks, listed: Mapping[str, Any]) -> None:
    """Fill the rows from the answer of the engine's command ``classes``. Raises ValueError, TypeError, KeyError."""
    masks.classes.clear()
    masks.path, masks.active = str(listed["path"]), 0
    masks.void = " ".join(str(int(number)) for number in listed.get("void", ()))
    for each in listed["rows"]:
        row = masks.classes.add()
        row.name, row.label, row.is_thing = str(each["name"]), int(each["label"]), bool(each["is_thing"])
        row.into = "" if each["into"] == each["name"] else str(each["into"])


def edited_classes(masks: PLGS_PG_masks) -> dict[str, Any]:
    """Return the panel's classes as input for the engine's ``classes --write``. Raises PlgsError for bad void ids."""
    rows = [
        {"label": row.label, "name": row.name, "into": row.into or row.name, "is_thing": row.is_thing}
        for row in masks.classes
    ]
    try:
        void = [int(word) for word in masks.void.split()]
    except ValueError as error:
        what = "the class numbers that count as void are not whole numbers"
        raise PlgsError("bad-void", what, masks.void, "Read the classes again.") from error
    return {"path": str(absolute(masks.path)), "rows": rows, "void": void}


CLASSES = (PLGS_PG_mask_class, PLGS_PG_masks)
PROPERTIES = ((bpy.types.Scene, "plgs_masks", PLGS_PG_masks),)


class ClassListing(SceneTask):
    """Lists the classes of masks in the rows of the scene named ``target``."""

    kind, label = "classes", "Reading the classes"
    undo_step = "PLGS Read Classes"

    def __init__(self, chosen: ChosenScene, target: str, follower: TaskFollower) -> None:
        super().__init__(chosen, follower)
        self._target = target

    def done(self, scene: Any) -> None:
        target = bpy.data.scenes.get(self._target)
        if self.answer is None or target is None:
            return
        try:
            fill_classes(target.plgs_masks, self.answer)
        except (ValueError, TypeError, KeyError) as fault:
            what = f"the engine's list of classes cannot be read ({fault!r})"
            raise PlgsError("bad-answer", what, self.chosen.scene, "Read the classes again.") from fault


class ClassWriting(SceneTask):
    kind, label, message = "write_classes", "Writing the classes", ""

    def done(self, scene: Any) -> None:
        if self.answer is not None:
            self.message = f"Classes written to {self.answer.get('path')}"
            looking.look_at_scene(self.chosen)


def read_classes(scene: bpy.types.Scene, table: str = OWN_TABLE) -> ClassListing:
    """Let an engine list the classes of the panel's scene's masks. ``table`` is one of TABLE_ITEMS, from which the list
    starts. Raises PlgsError without an engine; OSError."""
    registry.refuse_second(ClassListing)
    chosen = chosen_scene(scene.plgs)
    more = [] if table == OWN_TABLE else ["--table", table]
    follower = start_engine("classes", usable_python(), *chosen.arguments(), *more)
    return registry.begin(ClassListing(chosen, scene.name, follower))


def write_classes(scene: bpy.types.Scene) -> ClassWriting:
    """Let an engine write the rows to classes.toml beside the masks. Raises PlgsError for bad void ids or no engine."""
    registry.refuse_second(ClassWriting)
    chosen = chosen_scene(scene.plgs)
    edited = json.dumps(edited_classes(scene.plgs_masks))
    path = Path(bpy.app.tempdir) / "plgs-classes.json"
    path.write_text(edited, encoding="utf-8")
    follower = start_engine("classes", usable_python(), *chosen.arguments(), "--write", path)
    return registry.begin(ClassWriting(chosen, follower))


class Preparation(SceneTask):
    """A task that prepares a scene. At its end the panel reads the scene again, if it is still the chosen one."""

    def done(self, scene: Any) -> None:
        settings = scene.plgs
        if self.has_finished and settings.scene_folder and chosen_scene(settings) == self.chosen:
            self.take_scene(settings)
            looking.look_at_scene(chosen_scene(settings))

    def take_scene(self, settings: Any) -> None:
        """Put the scene that the task made, if any, into the settings."""


class MaskMaking(Preparation):
    """Makes masks. Those made before a cancel are kept, and the next run continues."""

    kind, label, cancel_operator = "masks", "Making masks", "plgs.cancel_masks"


class PoseMaking(Preparation):
    """Finds poses. The panel then switches to the scene that was made. After a cancel, nothing is written."""

    kind, label, cancel_operator = "poses", "Finding poses", "plgs.cancel_poses"

    @property
    def message(self) -> str:
        """What was made, in a line; "" before the end."""
        made = self.answer or {}
        return f"Poses of {made['posed']} of {made['photos']} photos" if "posed" in made else ""

    def take_scene(self, settings: Any) -> None:
        settings.scene_folder = str(Path((self.answer or {}).get("folder", self.chosen.scene)))


class DepthMaking(Preparation):
    """Makes depth. Maps made before a cancel are kept, and the next run continues."""

    kind, label, cancel_operator = "depth", "Making depth", "plgs.cancel_depth"


class ScaleSetting(Preparation):
    kind, label = "scale", "Setting the scale"

    @property
    def message(self) -> str:
        """The scale in a line; "" before it is set."""
        made = self.answer or {}
        return f"Lengths are multiplied by {made['scale']:.4g}: import the scene again" if "scale" in made else ""


class FilmMaking(Preparation):
    """Makes what a film or photos lack, then starts the lift, if they are still the panel's scene. What was made before
    a cancel is kept, and the next run continues."""

    kind, label, cancel_operator = "prepare", "Preparing the film", "plgs.cancel_film"

    def take_scene(self, settings: Any) -> None:
        settings.scene_folder = str(Path((self.answer or {}).get("folder", self.chosen.scene)))
        lifting.start_lift(settings)


def make_depth(chosen: ChosenScene, python: Path, model: str, *, download: bool) -> DepthMaking:
    """Start an engine that makes depth; arguments as in `make_masks`. Raises PlgsError if one runs; OSError."""
    registry.refuse_second(DepthMaking)
    command: list[str | Path] = [chosen.scene, f"--up={chosen.up_option}"]
    command += _network("--model", model, download=download)
    return registry.begin(DepthMaking(chosen, start_engine("depth", python, *command)))


def prepare_film(settings: Any, film: Path, python: Path, model: str, *, download: bool) -> FilmMaking:
    """Choose a film, or a folder of photos, as the scene, and start an engine that makes what it lacks (masks with the
    network ``model``), after which the lift starts. Raises PlgsError while another film is prepared; OSError."""
    registry.refuse_second(FilmMaking)
    settings.scene_folder = settings.masks = settings.detections = settings.depth = ""  # they belong to another scene
    settings.scene_folder = str(film)
    command: list[str | Path] = [film, *_network("--masks-model", model, download=download)]
    return registry.begin(FilmMaking(chosen_scene(settings), start_engine("prepare", python, *command)))


def set_scale(chosen: ChosenScene, python: Path, length: float, metres: float) -> ScaleSetting:
    """Start an engine that scales the scene so that what is now ``length`` long becomes ``metres`` long. Raises
    PlgsError if one is already running; OSError."""
    registry.refuse_second(ScaleSetting)
    command: list[str | Path] = [chosen.scene, "--measured", str(length), str(metres)]
    return registry.begin(ScaleSetting(chosen, start_engine("scale", python, *command)))


def _network(option: str, model: str, *, download: bool) -> list[str]:
    """Return arguments that name a network, a folder's absolute path or a name, and say if it may be fetched."""
    if model and absolute(model).is_dir():  # the engine's working folder is not Blender's
        model = str(absolute(model))
    return [*([option, model] if model else []), *(["--download"] if download else [])]


def make_masks(chosen: ChosenScene, python: Path, model: str, *, download: bool, every: bool = False) -> MaskMaking:
    """Start an engine that makes masks of the frames that matter, or of ``every`` one. ``model`` is a folder or a name
    on the Hugging Face Hub, from which it is fetched only with ``download``; "" is the engine's default. Raises
    OSError, and PlgsError if one is already running or cannot be started."""
    registry.refuse_second(MaskMaking)
    command: list[str | Path] = [chosen.scene, f"--up={chosen.up_option}", *([] if every else ["--frames=auto"])]
    command += [] if chosen.scene_format is None else ["--format", chosen.scene_format]
    command += _network("--model", model, download=download)
    return registry.begin(MaskMaking(chosen, start_engine("segment", python, *command)))


def make_poses(chosen: ChosenScene, python: Path) -> PoseMaking:
    """Start an engine that finds poses. Raises PlgsError if one is at work or none can be started; OSError."""
    registry.refuse_second(PoseMaking)
    return registry.begin(PoseMaking(chosen, start_engine("poses", python, chosen.scene)))
