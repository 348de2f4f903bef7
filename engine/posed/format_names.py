"""The names of formats of scenes and masks and of public class tables, as options, messages and Blender show them.

``formats/`` and ``mask_formats/`` have a reader for each; a test checks that these tables name them all.
"""

from __future__ import annotations

from typing import NamedTuple


class FormatName(NamedTuple):
    """The ``name`` that options use, the ``label`` for people, and the files that the format's reader looks for."""

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
)

MASK_FORMAT_NAMES = (
    FormatName("coco", "coco", "panoptic.json and the PNGs in panoptic"),
    FormatName("panoptic-lifting", "panoptic-lifting", "m2f_semantics and m2f_instance"),
    FormatName("grounded-sam2", "grounded-sam2", "mask_data/mask_<frame>.npy and json_data/mask_<frame>.json"),
    FormatName("sam", "sam", "<frame>/metadata.csv with <frame>/<k>.png, as SAM's amg.py writes them"),
    FormatName("pairs", "pairs", "folders semantic and instance (or class, label-filt, semantic_class and theirs)"),
    FormatName("transformers", "transformers", "<frame>.json with label_id and <frame>.npy or .png"),
    FormatName("detectron2", "detectron2", "<frame>.json with category_id and <frame>.npy or .png"),
    FormatName("sam2", "sam2", "<frame>.png with a palette, or <object number>/<frame>.png"),
    FormatName("palette", "palette", "<frame>.png with a palette, or grey, whose values are classes"),
    FormatName(
        "detections",
        "detections",
        "<frame>.npz with masks, classes and scores, or <frame>/<k>_<class>_<score>.png",
    ),  # fmt: skip
    FormatName("arrays", "arrays", "<frame>.npy or .npz with classes [H, W], or with probabilities [C, H, W]"),
)

_PLAIN = "Convert it to the folders color, depth, pose and intrinsic, as docs/captures.md describes them."
_AS_COCO = "Write the ids of your renders as COCO panoptic PNGs with panoptic.json, as docs/masks.md describes them."
GONE_FORMATS = {
    **dict.fromkeys(("icl", "vmap", "posed-images", "open3d"), _PLAIN),
    "tsdf-fusion": "Name it 7scenes, which reads camera-intrinsics.txt.",
    **dict.fromkeys(("cryptomatte", "object-index"), _AS_COCO),
}
"""What to do with formats of earlier versions."""

TABLES = ("coco", "ade20k", "cityscapes", "nyu40", "nyu13", "scannet", "scannet200", "replica", "reduced")
"""The public tables of classes."""
NUMBERINGS = (
    "ade20k:0-149", "ade20k:1-150", "cityscapes:0-18", "cityscapes:0-33", "coco:0-132", "coco:90",
    "nyu40:1-40", "nyu40:0-39", "nyu13:1-13", "nyu13:0-12", "scannet:1-1357",
)  # fmt: skip
"""Tables whose files number classes in several ways, or as another table could, with the way: first the usual one."""
