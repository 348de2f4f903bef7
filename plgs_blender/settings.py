"""What the user chose in the panel: kept with the scene in the .blend, undone with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty

from ..engine.job import JobError, LiftRequest
from ..engine.job.options import DEFAULTS, chosen_options
from ..engine.job.preset_options import parsed_options, preset_options, shown_options, shown_value
from ..engine.job.request import LARGEST_SIDE, SMALLEST_SIDE
from .panel_words import in_panel_words
from .paths import absolute
from .running import poll_timer
from .scene_formats import AUTOMATIC, FORMAT_ITEMS, MASK_FORMAT_ITEMS, chosen_format
from .scene_survey import Place, classes_of

_PRESETS = [
    ("preview", "Preview", "Minutes: to see whether frames, poses and masks fit together"),
    ("standard", "Standard", "The best result, in a few times the minutes"),
    ("paper", "Paper", "The paper's own way and number of steps: hours"),
]
UPS = [
    ("z", "Z", "The poses' z axis points up"),
    ("y", "Y", "The poses' y axis points up"),
    ("-y", "-Y", "The poses' y axis points down, as in a camera"),
]
_BAKES = [
    ("test", "Held-out frames", "Bake the passes of the frames that are held out of training"),
    ("all", "All frames", "Bake the passes of every frame"),
    ("none", "None", "Bake no passes; they can be baked later"),
]
_DEVICES = [
    ("cpu", "CPU", "Draw the Gaussians on the processor"),
    ("cuda", "CUDA", "Draw them on an NVIDIA GPU; the engine's Python needs gsplat, and this has not run on a GPU yet"),
]

_FORMATS = {name for name, *_ in FORMAT_ITEMS}
_MASK_FORMATS = {name for name, *_ in MASK_FORMAT_ITEMS}
_PATHS = ("lift_folder", "scene_folder", "masks", "depth")
_OPTION = {"SKIP_SAVE"}
"""So that an operator does not remember what a script once gave it."""


def _look_at_scene(settings: LiftOptions, context: bpy.types.Context) -> None:
    if isinstance(settings, PLGS_PG_settings) and settings.scene_folder:
        poll_timer.look_at_scene(place_of(settings))


def _look_at_lift(settings: LiftOptions, context: bpy.types.Context) -> None:
    if isinstance(settings, PLGS_PG_settings) and settings.lift_folder:
        poll_timer.look_at_lift(absolute(settings.lift_folder))


class LiftOptions:
    """What a lift is asked for: properties of the settings and of the operator that starts one.

    Zero for steps, width, height and frames leaves them to the preset.
    """

    scene_folder: StringProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Scene", subtype="DIR_PATH", update=_look_at_scene,
        description="A capture's folder or file: ScanNet, transforms.json, COLMAP, Polycam, .r3d, .sens and others",
    )  # fmt: skip
    format: EnumProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Format", items=FORMAT_ITEMS, default=AUTOMATIC, update=_look_at_scene,
        description="How the scene is laid out, where its looks do not tell",
    )  # fmt: skip
    masks: StringProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Masks", subtype="FILE_PATH", update=_look_at_scene,
        description="Panoptic masks that lie elsewhere than in the scene's folder",
    )  # fmt: skip
    mask_format: EnumProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Mask format", items=MASK_FORMAT_ITEMS, default=AUTOMATIC, update=_look_at_scene,
        description="How the masks are laid out, where their looks do not tell",
    )  # fmt: skip
    classes_table: StringProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Classes", update=_look_at_scene,
        description="The masks' classes: a .toml file, or one of coco, ade20k, nyu40, replica, reduced; "
        "empty: classes.toml beside them",
    )  # fmt: skip
    depth: StringProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Depth maps", subtype="DIR_PATH", update=_look_at_scene,
        description="Folder of a network's depth maps, one a frame, fitted to the sparse points where there are some",
    )  # fmt: skip
    up: EnumProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Up", items=UPS, default="z", update=_look_at_scene,
        description="The axis of the poses that points up",
    )  # fmt: skip
    preset: EnumProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Preset", items=_PRESETS, default="preview", description="How much work to spend"
    )
    steps: IntProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Steps", min=0, max=10_000_000, description="Training steps; 0 takes the preset's"
    )
    width: IntProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Width", min=0, max=LARGEST_SIDE, subtype="PIXEL",
        description=f"Frames are brought within this width, at least {SMALLEST_SIDE}; 0 takes the preset's",
    )  # fmt: skip
    height: IntProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Height", min=0, max=LARGEST_SIDE, subtype="PIXEL",
        description=f"Frames are brought within this height, at least {SMALLEST_SIDE}; 0 takes the preset's",
    )  # fmt: skip
    frames: IntProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Frames", min=-1, max=1_000_000,
        description="Train on at most so many frames, the sharpest of each stretch; 0 takes the preset's, -1 all",
    )  # fmt: skip
    fit: BoolProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Fit memory", description="Train on fewer frames where memory would not do otherwise"
    )
    seed: IntProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Seed", min=0, max=2**31 - 1, description="Start of all chance: same seed, same result"
    )
    bake: EnumProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Bake", items=_BAKES, default="test", description="Which frames become compositor passes"
    )
    device: EnumProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Device", items=_DEVICES, default="cpu", description="Where the Gaussians are drawn"
    )
    preset_options: StringProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Changed",
        description="Any options of the preset, such as: weights.depth=0 objects=boxes; empty takes the preset's",
    )  # fmt: skip
    lift_folder: StringProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Lift folder", subtype="DIR_PATH", update=_look_at_lift,
        description="Where the lift and its results go; empty: a new folder beside the scene's",
    )  # fmt: skip
    keep_names: BoolProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Keep names", default=True,
        description="Objects that the lift shown in this scene has found already keep their names and ids",
    )  # fmt: skip
    keep_running: BoolProperty(  # type: ignore[valid-type]
        options=_OPTION, name="Go on without Blender",
        description="Closing Blender does not stop the lift; the next Blender finds it again",
    )


class PLGS_PG_settings(LiftOptions, bpy.types.PropertyGroup):
    """`scene.plgs`: what the panel shows and the operators start from."""

    live_preview: BoolProperty(  # type: ignore[valid-type]
        name="Live preview", default=True,
        description="While it lifts, show what the scene's active camera sees in the model, when looking through it",
    )  # fmt: skip
    place_when_done: BoolProperty(  # type: ignore[valid-type]
        name="Show when done", default=True, description="Put the result into this scene as soon as it is there"
    )


def place_of(settings: PLGS_PG_settings) -> Place:
    """Which scene the settings name."""
    return Place.of(
        settings.scene_folder, settings.masks, settings.up, settings.format, settings.depth, settings.mask_format,
        settings.classes_table,
    )  # fmt: skip


def chosen_lift(settings: PLGS_PG_settings) -> Path | None:
    """The lift folder that the settings name, None when they name none."""
    return absolute(settings.lift_folder) if settings.lift_folder else None


def size_of(settings: PLGS_PG_settings) -> tuple[int, int] | None:
    """The box (width, height) in pixels that frames are brought into; None leaves it to the preset. 0 is no limit."""
    if not settings.width and not settings.height:
        return None
    return settings.width or LARGEST_SIDE, settings.height or LARGEST_SIDE


def frames_of(settings: PLGS_PG_settings) -> int | None:
    """How many frames are trained on at most, as a request has it: 0 is all, None leaves it to the preset."""
    return max(settings.frames, 0) if settings.frames else None


def request_of(settings: PLGS_PG_settings) -> LiftRequest:
    """What the settings ask for. Raises JobError when a value is out of range."""
    return LiftRequest(
        **asked_of_preset(settings),
        fit=settings.fit,
        scene=absolute(settings.scene_folder),
        masks=absolute(settings.masks) if settings.masks else None,
        seed=settings.seed,
        up=settings.up,
        bake=settings.bake,
        device=settings.device,
        scene_format=chosen_format(settings.format),
        depth=absolute(settings.depth) if settings.depth else None,
        mask_format=chosen_format(settings.mask_format),
        classes=classes_of(settings.classes_table),
    )


def asked_of_preset(settings: PLGS_PG_settings) -> dict[str, Any]:
    """``preset``, ``options`` and, where the settings change these, ``steps``, ``size`` and ``frames`` of a request.
    Fields win over the same among all options. Raises JobError for a name or a value that is none."""
    steps = settings.steps or None
    fields = {"steps": steps, "size": size_of(settings), "frames": frames_of(settings)}
    chosen = chosen_options(settings.preset, settings.preset_options.split(), DEFAULTS, steps)
    return chosen | {name: value for name, value in fields.items() if value is not None}


def why_no_options(settings: PLGS_PG_settings) -> str | None:
    """What is wrong with the options that the settings change; None when they can be."""
    try:
        asked_of_preset(settings)
    except JobError as error:
        return in_panel_words(str(error))
    return None


def shown_preset(settings: PLGS_PG_settings) -> list[tuple[str, str, bool]]:
    """Name and value of every option of the chosen preset, and whether the settings change it."""
    try:
        changed = parsed_options(settings.preset_options.split())
    except JobError:
        changed = {}
    values = {name: option.values[settings.preset] for name, option in preset_options().items()}
    return [(name, shown_value(changed.get(name, value)), name in changed) for name, value in values.items()]


def adopt(settings: PLGS_PG_settings, request: LiftRequest, folder: Path) -> None:
    """Let the settings say what the lift in `folder` was asked for."""
    width, height = request.size or (0, 0)
    asked: dict[str, str | int] = {
        "lift_folder": str(folder),
        "scene_folder": str(request.scene),
        "masks": "" if request.masks is None else str(request.masks),
        "up": request.up,
        "format": request.scene_format if request.scene_format in _FORMATS else AUTOMATIC,
        "depth": "" if request.depth is None else str(request.depth),
        "mask_format": request.mask_format if request.mask_format in _MASK_FORMATS else AUTOMATIC,
        "classes_table": request.classes or "",
        "preset": request.preset,
        "steps": request.steps or 0,
        "width": width,
        "height": height,
        "frames": 0 if request.frames is None else request.frames or -1,
        "fit": request.fit,
        "seed": min(request.seed, 2**31 - 1),
        "bake": request.bake,
        "device": request.device,
        "preset_options": " ".join(shown_options(request.options)),
    }
    for name, value in asked.items():
        now = getattr(settings, name)
        is_same_path = name in _PATHS and now and value and absolute(now) == Path(str(value))
        if now != value and not is_same_path:  # each assignment lets the folder be looked at anew
            setattr(settings, name, value)


CLASSES = (PLGS_PG_settings,)


def register() -> None:
    bpy.types.Scene.plgs = PointerProperty(type=PLGS_PG_settings)


def unregister() -> None:
    del bpy.types.Scene.plgs
