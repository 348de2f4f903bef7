"""The user's settings in the panel, saved with the scene in the .blend and undone with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..engine.errors import PlgsError
from ..engine.job import LiftRequest
from ..engine.job.request import chosen_options
from ..engine.presets import options as presets
from ..engine.presets.preset import LONGEST_SIDE, PRESETS, SHORTEST_SIDE
from .chosen_scene import AUTOMATIC, FORMAT_ITEMS, MASK_FORMAT_ITEMS, ChosenScene, absolute, as_texts
from .compat import BLEND_RELATIVE
from .engine_environment import studio
from .errors import with_field_names

_PRESETS = [
    ("draft", "Draft", "Under half of Preview's time; a first room, which Refine makes better"),
    ("preview", "Preview", "Takes minutes; shows whether frames, poses and masks fit together"),
    ("standard", "Standard", "The best result; takes a few times as long as Preview"),
    ("paper", "Thorough", "Takes hours; the paper's method and number of steps"),
]
UPS = [
    ("z", "Automatic", "The axis given by the capture's format, else the poses' z axis"),
    ("+z", "Z", "The poses' z axis points up, whatever the capture's format says"),
    ("y", "Y", "The poses' y axis points up"),
    ("-y", "-Y", "The poses' y axis points down, as in a camera"),
]
_LAYERS = [
    ("normal", "Normal", "The surface's normal; takes a third more disk space"),
    ("position", "Position", "The surface's position in the world; more than doubles the disk space"),
    ("vector", "Vector", "Pixels to the previous and the next frame, for Vector Blur; more than doubles the space"),
]
_BAKES = [
    ("usual", "Preset's", "Bake the test frames; none in a draft"),
    ("test", "Check Frames", "Bake the passes of the held-out frames, which the lift does not learn from"),
    ("all", "All Frames", "Bake the passes of every frame"),
    ("none", "None", "Bake no passes now; you can bake them later"),
]
_DEVICES = [
    ("cpu", "CPU", "Train and render on the processor"),
    ("cuda", "CUDA", "Experimental: never run by us on a GPU. Needs an NVIDIA GPU, torch for CUDA, and gsplat"),
    ("auto", "Automatic", "The CPU, until CUDA is no longer experimental"),
]

PATHS = ("lift_folder", "scene_folder", "masks", "detections", "depth", "classes_table")
"""Names of the properties that are paths, or may be."""
_SKIP_SAVE = {"SKIP_SAVE"}  # so that an operator does not remember what a script once passed to it
_PATH = _SKIP_SAVE | BLEND_RELATIVE

Listener = Callable[["PLGS_PG_settings"], None]
on_scene_chosen: list[Listener] = []
"""Called with the settings after their description of a scene has changed."""
on_lift_chosen: list[Listener] = []
"""Called with the settings after their lift folder has changed."""
_is_unheard = False


@contextmanager
def unheard() -> Iterator[None]:
    """In a ``with`` block, let code rewrite paths in the settings without the panel reading them again."""
    global _is_unheard
    _is_unheard = True
    try:
        yield
    finally:
        _is_unheard = False


def _tell_of_scene(settings: SceneOptions, context: bpy.types.Context) -> None:
    if isinstance(settings, PLGS_PG_settings) and settings.scene_folder and not _is_unheard:
        for listener in on_scene_chosen:
            listener(settings)


def _take_defaults(settings: SceneOptions, context: bpy.types.Context) -> None:
    """Show the studio's defaults in fields that the user has not set. Its file is checked when a lift starts."""
    if isinstance(settings, PLGS_PG_settings) and settings.scene_folder and not _is_unheard:
        with suppress(PlgsError):
            defaults = studio()
            masks, every = (str(defaults.masks_of(path) or "") for path in (absolute(settings.scene_folder), None))
            if masks and (not settings.masks or fnmatch(settings.masks, every.replace("{scene}", "*"))):
                settings.masks = masks
            if defaults.device and not settings.is_property_set("device"):
                settings.device = defaults.device
            if defaults.preset and not settings.is_property_set("preset"):
                settings.preset, options = chosen_options(defaults.preset, {})
                settings.preset_options = " ".join(presets.shown_options(options))
    _tell_of_scene(settings, context)


def _tell_of_lift(settings: SceneOptions, context: bpy.types.Context) -> None:
    if isinstance(settings, PLGS_PG_settings) and settings.lift_folder and not _is_unheard:
        for listener in on_lift_chosen:
            listener(settings)


# fmt: off
class SceneOptions:
    """Properties of the settings and of operators that say how to read a scene."""

    format: EnumProperty(options=_SKIP_SAVE, name="Format", items=FORMAT_ITEMS, default=AUTOMATIC,
        update=_tell_of_scene, description="The scene's layout, if it cannot be detected from its files")
    masks: StringProperty(options=_PATH, name="Masks", subtype="FILE_PATH", update=_tell_of_scene,
        description="Panoptic masks outside the scene's folder")
    mask_format: EnumProperty(options=_SKIP_SAVE, name="Mask Format", items=MASK_FORMAT_ITEMS, default=AUTOMATIC,
        update=_tell_of_scene, description="The masks' layout, if it cannot be detected from their files")
    detections: StringProperty(options=_PATH, name="Detections", subtype="FILE_PATH", update=_tell_of_scene,
        description="Detections to draw over the masks, which may overlap: a JSON of COCO results or instances")
    classes_table: StringProperty(options=_SKIP_SAVE, name="Classes", update=_tell_of_scene,
        description="The masks' classes: a .toml file, or one of coco, ade20k, cityscapes, nyu40, nyu13, scannet, "
        "scannet200, replica, reduced; empty: classes.toml beside them")
    depth: StringProperty(options=_PATH, name="Depth", subtype="FILE_PATH", update=_tell_of_scene,
        description="A folder of depth maps by a network, which are fitted to the sparse points, if any; or a mesh")
    up: EnumProperty(options=_SKIP_SAVE, name="Up", items=UPS, default="z", update=_tell_of_scene,
        description="The axis of the poses that points up")


class LiftOptions(SceneOptions):
    """Properties of the settings and of the operator that starts a lift: the lift's options."""

    scene_folder: StringProperty(options=_PATH, name="Scene", subtype="DIR_PATH", update=_take_defaults,
        description="A capture's folder or file: ScanNet, transforms.json, COLMAP, Polycam, .r3d, .sens and others")
    preset: EnumProperty(options=_SKIP_SAVE, name="Preset", items=_PRESETS, default="preview",
        description="How much work to spend")
    steps: IntProperty(options=_SKIP_SAVE, name="Steps", min=0, max=10_000_000,
        description="Training steps; 0 uses the preset's")
    width: IntProperty(options=_SKIP_SAVE, name="Width", min=0, max=LONGEST_SIDE, subtype="PIXEL",
        description=f"Frames are scaled to fit this width, at least {SHORTEST_SIDE}; 0 uses the preset's")
    height: IntProperty(options=_SKIP_SAVE, name="Height", min=0, max=LONGEST_SIDE, subtype="PIXEL",
        description=f"Frames are scaled to fit this height, at least {SHORTEST_SIDE}; 0 uses the preset's")
    frames: IntProperty(options=_SKIP_SAVE, name="Frames", min=-1, max=1_000_000,
        description="Train on at most this many frames, the sharpest of each stretch; 0 uses the preset's, -1 all")
    fit: BoolProperty(options=_SKIP_SAVE, name="Fit Memory",
        description="Train on fewer frames if memory would otherwise run out")
    seed: IntProperty(options=_SKIP_SAVE, name="Seed", min=0, max=2**31 - 1,
        description="The same seed gives the same result")
    bake: EnumProperty(options=_SKIP_SAVE, name="Bake", items=_BAKES, default="usual",
        description="Which frames become compositor passes")
    device: EnumProperty(options=_SKIP_SAVE, name="Device", items=_DEVICES, default="cpu",
        description="Where the lift trains and renders")
    preset_options: StringProperty(options=_SKIP_SAVE, name="Changed",
        description="Changed options of the preset, such as: weights.depth=0 objects=boxes")
    lift_folder: StringProperty(options=_PATH, name="Lift Folder", subtype="DIR_PATH", update=_tell_of_lift,
        description="Where the lift and its results go; empty: a new folder beside the scene's")
    keep_names: BoolProperty(options=_SKIP_SAVE, name="Keep Names", default=True,
        description="Objects found by the lift shown in this scene keep their names and ids")
    anyway: BoolProperty(options=_SKIP_SAVE, name="Lift Anyway",
        description="Lift the scene even if its numbers or masks are clearly wrong")
    keep_running: BoolProperty(options=_SKIP_SAVE, name="Outlive Blender",
        description="The lift continues when Blender closes; the next Blender finds it again")


class PLGS_PG_settings(LiftOptions, bpy.types.PropertyGroup):
    """The panel's settings, from which operators start: `scene.plgs`."""

    live_preview: BoolProperty(name="Live Preview", default=True,
        description="During a lift, show what the scene's active camera sees of the model in views through it. "
        "Orthographic and panoramic cameras show nothing")
    layers: EnumProperty(name="Layers", items=_LAYERS, options={"ENUM_FLAG"},
        description="Layers besides colour, depth, class, instance, confidence and Cryptomatte")
    shot: StringProperty(name="Shot",
        description="Name of the files of a camera's passes; empty: the names of the .blend and the camera")
    replace_shot: BoolProperty(name="Replace",
        description="Replace a shot of this name that belongs to another file or camera, or whose camera has changed")
    show_steps: BoolProperty(name="Scene and Lift",
        description="Show the steps that led to the result, for example to begin the next lift")
    place_when_done: BoolProperty(name="Show When Done", default=True,
        description="Put the result into this scene as soon as it is finished")


# fmt: on


def option_names(options: type) -> list[str]:
    """Return the names of a class's properties, with those of its base classes."""
    return [name for each in reversed(options.__mro__) for name in each.__dict__.get("__annotations__", ())]


def chosen_scene(settings: PLGS_PG_settings) -> ChosenScene:
    """Return the scene that the settings name."""
    return ChosenScene.of(
        settings.scene_folder, masks=settings.masks, up=settings.up, format=settings.format, depth=settings.depth,
        mask_format=settings.mask_format, classes=settings.classes_table, detections=settings.detections,
    )  # fmt: skip


def chosen_lift(settings: PLGS_PG_settings) -> Path | None:
    """Return the lift folder that the settings name, None if they name none."""
    return absolute(settings.lift_folder) if settings.lift_folder else None


def request_of(settings: PLGS_PG_settings) -> LiftRequest:
    """Return the lift request that the settings describe. Raises PlgsError if a value is out of range."""
    preset, options = asked_of_preset(settings)
    others = {name: getattr(settings, name) for name in ("fit", "anyway", "seed", "device")}
    others["bake"] = None if settings.bake == "usual" else settings.bake
    return LiftRequest(**vars(chosen_scene(settings)), preset=preset, options=options, **others)


def asked_of_preset(settings: PLGS_PG_settings) -> tuple[Any, dict[str, Any]]:
    """Return the preset's name and its changed options. The panel's fields take precedence over its text of options.
    Raises PlgsError for bad options."""
    changed = presets.parsed_options(settings.preset_options.split())
    if settings.steps:
        changed["steps"] = settings.steps
    if settings.width or settings.height:  # 0 is no limit
        changed["size"] = [settings.width or LONGEST_SIDE, settings.height or LONGEST_SIDE]
    if settings.frames:  # -1: all
        changed["frames"] = max(settings.frames, 0)
    preset, options = chosen_options(settings.preset, changed)
    return preset, presets.checked_options(options)


def why_no_options(settings: PLGS_PG_settings) -> str | None:
    """Return what is wrong with the changed options, None if they are right."""
    try:
        asked_of_preset(settings)
    except PlgsError as error:
        return with_field_names(error)
    return None


def shown_preset(settings: PLGS_PG_settings) -> list[tuple[str, str, bool]]:
    """Return every option of the chosen preset: name, value, and whether the settings change it."""
    try:
        changed = presets.parsed_options(settings.preset_options.split())
    except PlgsError:
        changed = {}
    values = {name: presets.option_value(PRESETS[settings.preset], name) for name in presets.preset_options()}
    return [(name, presets.shown_value(changed.get(name, value)), name in changed) for name, value in values.items()]


def adopt(settings: PLGS_PG_settings, request: LiftRequest, folder: Path) -> None:
    """Copy the options of the lift in `folder` to the settings."""
    options: dict[str, Any] = dict(request.options)
    steps, (width, height), frames = options.pop("steps", 0), options.pop("size", (0, 0)), options.pop("frames", None)
    texts = as_texts(request)
    asked: dict[str, str | int] = {
        "lift_folder": str(folder),
        "scene_folder": str(request.scene),
        "classes_table": texts.pop("classes"),
        **texts,
        "preset": request.preset,
        "steps": steps,
        "width": width,
        "height": height,
        "frames": 0 if frames is None else frames or -1,
        "fit": request.fit,
        "anyway": request.anyway,
        "seed": min(request.seed, 2**31 - 1),  # Blender's integers have 32 bits, with a sign
        "bake": request.bake or "usual",
        "device": request.device,
        "preset_options": " ".join(presets.shown_options(options)),
    }
    for name, value in asked.items():
        now = getattr(settings, name)
        is_same_path = name in PATHS and now and value and absolute(now) == Path(str(value))
        if now != value and not is_same_path:  # each assignment makes us look at the folder again
            setattr(settings, name, value)


CLASSES = (PLGS_PG_settings,)
PROPERTIES = ((bpy.types.Scene, "plgs", PLGS_PG_settings),)
