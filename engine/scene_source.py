"""The place of a scene and how to read it, for commands, requests and the panel; and the names of formats. A field's
metadata holds `argparse` keywords for the command-line ``option`` that sets it."""

from __future__ import annotations

from argparse import ArgumentTypeError
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

UpAxis = Literal["z", "y", "-y", "+z"]
UPS: tuple[str, ...] = get_args(UpAxis)
UP_OPTIONS: dict[str, UpAxis] = {"auto": "z", "z": "+z", "y": "y", "-y": "-y"}  # the values of --up, and their meanings


def option(help: str, metavar: str, type: Any = str, **more: Any) -> dict[str, Any]:
    """Return the metadata of a dataclass field that a command-line option sets: `argparse` keywords for it."""
    return {"option": {"help": help, "metavar": metavar, "type": type, **more}}


def _set_by(help: str, metavar: str, type: Any = str, default: Any = None) -> Any:
    """Declare a dataclass field with a ``default`` that a command-line option sets, described as for `option`."""
    return field(default=default, metadata=option(help, metavar, type))


def up_axis(text: str) -> str:
    """Parse a value of --up, for argparse. Raises ArgumentTypeError."""
    if text not in UP_OPTIONS:
        raise ArgumentTypeError(f"{text!r} is not one of {',  '.join(UP_OPTIONS)}")
    return UP_OPTIONS[text]


def class_table(text: str) -> str:
    """Return the name of a class table unchanged, or the absolute path of a file, for argparse."""
    return str(Path(text).resolve()) if text.endswith(".toml") else text


@dataclass(frozen=True)
class SceneSource:
    """A scene and how to read it. ``scene`` is its folder or file. ``masks`` names panoptic masks outside the folder.
    ``up`` is the upward axis of the poses' world; "z" leaves it to formats that know, "+z" is always the z axis.
    ``scene_format`` and ``mask_format`` name formats that are otherwise recognised. ``depth`` is a folder of depth
    maps, or a mesh, to use instead of the scene's. ``classes`` is the name of a table of the masks' classes, or the
    path of a .toml file. ``detections`` is a JSON of possibly overlapping segments that are laid over the masks."""

    scene: Path
    masks: Path | None = _set_by("panoptic masks, if not in SCENE itself", "PATH", Path)
    up: UpAxis = _set_by(
        "the axis of the poses that points up (default: auto, what the format says, else z)",
        "|".join(UP_OPTIONS), up_axis, "z",
    )  # fmt: skip
    scene_format: str | None = _set_by(
        "how SCENE is laid out, such as colmap, nerfstudio, polycam, tum (default: recognised by its files)", "NAME"
    )
    depth: Path | None = _set_by(
        "a network's depth maps, fitted to the scene's sparse points, or a mesh (PLY, OBJ, GLB)", "MAPS|MESH", Path
    )
    mask_format: str | None = _set_by(
        "how the masks are laid out, such as coco, transformers, sam2, pairs (default: recognised by their files)",
        "NAME",
    )
    classes: str | None = _set_by(
        "the masks' classes, or one of coco, ade20k, cityscapes, nyu40, nyu13, scannet, scannet200, replica, "
        "reduced, or with its numbering, such as ade20k:1-150 or coco:90 (default: classes.toml beside them)",
        "FILE.toml",
        class_table,
    )
    detections: Path | None = _set_by(
        "detections over the masks, which may overlap: COCO results or instances, as RLE or polygons", "FILE.json", Path
    )

    @property
    def up_option(self) -> str:
        """The --up value for this ``up`` axis."""
        return next(option for option, up in UP_OPTIONS.items() if up == self.up)

    @property
    def resolved(self) -> SceneSource:
        """Return the same source with absolute paths, and links followed."""
        given: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(SceneSource)}
        paths = {name: value.resolve() for name, value in given.items() if isinstance(value, Path)}
        table = None if self.classes is None else class_table(self.classes)
        return SceneSource(**{**given, **paths, "classes": table})


class FormatName(NamedTuple):
    """A format: the ``name`` that options use, the ``label`` for people, and the files that its reader looks for."""

    name: str
    label: str
    looks_for: str


SCENE_FORMAT_NAMES = (
    FormatName("scannet", "ScanNet folders", "the folders color, pose and intrinsic"),
    FormatName("nerfstudio", "transforms.json (nerfstudio)", "transforms.json"),
    FormatName("colmap", "COLMAP", "cameras and images, .bin or .txt, in sparse/0, sparse, model or colmap/sparse/0"),
    FormatName("tum", "TUM RGB-D", "groundtruth.txt with the folder rgb"),
    FormatName("7scenes", "7-Scenes", "frame-000000.pose.txt and .color.png, in the folder or in seq-01"),
    FormatName("replica", "Replica (NICE-SLAM)", "traj.txt with results/frame000000.jpg"),
    FormatName("sens", "ScanNet .sens", "a .sens file"),
    FormatName("polycam", "Polycam", "keyframes/cameras and keyframes/images"),
    FormatName("record3d", "Record3D .r3d", "a .r3d file, or metadata with the folder rgbd"),
    FormatName("stray", "Stray Scanner", "odometry.csv, camera_matrix.csv and rgb.mp4"),
    FormatName("scanner-app", "3D Scanner App", "frame_00000.jpg and frame_00000.json with cameraPoseARFrame"),
    FormatName("scannetpp", "ScanNet++ iPhone", "iphone/pose_intrinsic_imu.json"),
    FormatName("hypersim", "Hypersim", "_detail/metadata_scene.csv and images/scene_cam_00_geometry_hdf5"),
    FormatName("arkitscenes", "ARKitScenes", "lowres_wide.traj with pictures in wide, vga_wide or lowres_wide"),
    FormatName("metashape", "Metashape", "an .xml file of Metashape's cameras beside the photos"),
    FormatName("reality", "RealityScan", "a .csv file of internal and external camera parameters beside the photos"),
    FormatName("bundler", "Bundler", "an .out file of Bundler beside the photos"),
)

_LOOKS_FOR_MASKS = {
    "coco-detections": "a .json, or one a frame: results as of COCO, instances of COCO or LVIS, masklets of SA-V",
    "coco": "panoptic.json and the PNGs in panoptic",
    "panoptic-lifting": "m2f_semantics and m2f_instance",
    "grounded-sam2": "mask_data/mask_<frame>.npy and json_data/mask_<frame>.json",
    "sam": "<frame>/metadata.csv with <frame>/<k>.png, as SAM's amg.py writes them",
    "pairs": "folders semantic and instance (or class, label-filt, semantic_class and theirs)",
    "transformers": "<frame>.json with label_id and <frame>.npy or .png",
    "detectron2": "<frame>.json with category_id and <frame>.npy or .png",
    "sam2": "<frame>.png with a palette, or <object number>/<frame>.png",
    "palette": "<frame>.png with a palette, or grey, whose values are classes",
    "detections": "<frame>.npz with masks, classes and scores, or <frame>/<k>_<class>_<score>.png",
    "arrays": "<frame>.npy or .npz with classes [H, W], or with probabilities [C, H, W]",
}
MASK_FORMAT_NAMES = tuple(FormatName(name, name, looks_for) for name, looks_for in _LOOKS_FOR_MASKS.items())

FILMS = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv"})
"""Suffixes of films, in lower case."""
MADE_POSES = "sparse/0/made_by.json"
"""The note of `python -m engine poses` in a scene's folder."""
TABLES = ("coco", "ade20k", "cityscapes", "nyu40", "nyu13", "scannet", "scannet200", "replica", "reduced")
"""The public tables of classes."""
NUMBERINGS = (
    "ade20k:0-149", "ade20k:1-150", "cityscapes:0-18", "cityscapes:0-33", "coco:0-132", "coco:90",
    "nyu40:1-40", "nyu40:0-39", "nyu13:1-13", "nyu13:0-12", "scannet:1-1357",
)  # fmt: skip
"""Numberings of tables that have several, or one that another table's resembles; the most usual first."""
