"""A small sample of each layout and each kind of masks, whose files may be spoilt for a while."""

import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from engine.scene import Scene, open_scene
from tests.scene.formats import (
    test_arkitscenes,
    test_colmap,
    test_hypersim,
    test_nerfstudio,
    test_phone_apps,
    test_photogrammetry,
    test_record3d,
    test_scannet,
    test_scannetpp,
    test_seven_scenes,
    test_tum,
)
from tests.scene.mask_formats import (
    test_coco_detections,
    test_detections,
    test_label_images,
    test_segment_maps,
    test_tracks,
)
from tests.scene.mask_formats.labelled_room import write_masked_frames
from tests.scene.refusing import describe
from tests.tiny_scene import write_tiny_scene


def arrays(folder: Path) -> None:
    def save(path: Path, truth: test_label_images.Truth) -> None:
        np.save(f"{path}.npy", test_label_images.in_table(truth, test_label_images.NYU).astype(np.uint16))

    test_label_images.write_arrays(folder, save)


def unpacked_r3d(folder: Path) -> None:
    with zipfile.ZipFile(test_record3d.write_r3d(folder / "a.r3d")) as archive:
        archive.extractall(folder)
    (folder / "a.r3d").unlink()


def coco_detections(folder: Path, pack: Callable[..., object]) -> None:
    """Each entry has all that one may have."""
    masks, truths = write_masked_frames(folder)
    content = test_coco_detections.instances(truths, pack=pack)
    for entry in content["annotations"]:
        entry |= {"score": 0.5, "predicted_iou": 0.5, "track": 3, "scores": {str(entry["category_id"]): 0.5}}
    test_coco_detections.wrote(masks / "instances.json", content)


WRITERS: dict[str, Callable[[Path], object]] = {
    "scannet": lambda folder: write_tiny_scene(
        folder, frames=3, size=(16, 12), splits={"train": ["0000", "0001"], "test": ["0002"]}
    ),
    "nerfstudio": test_nerfstudio.write_scene,
    "colmap": test_colmap.write_text,
    "colmap-binary": test_colmap.binary,
    "tum": test_tum.write_tum,
    "7scenes": test_seven_scenes.write_seven,
    "replica": test_seven_scenes.write_nice,
    "sens": lambda folder: (folder / "a.sens").write_bytes(test_scannet.sens()),
    "polycam": test_phone_apps.write_polycam,
    "scanner-app": test_phone_apps.write_scanner_app,
    "record3d": lambda folder: test_record3d.write_r3d(folder / "a.r3d"),
    "record3d-unpacked": unpacked_r3d,
    "stray": test_phone_apps.write_stray,
    "scannetpp": lambda folder: test_scannetpp.write_scannetpp(folder, test_scannetpp.lz4_blocks),
    "hypersim": lambda folder: test_hypersim.write_hypersim(folder / "ai_001_001", test_hypersim.USUAL),
    "arkitscenes": lambda folder: test_arkitscenes.write_video(folder, "lowres_wide"),
    "metashape": lambda folder: test_photogrammetry.metashape_xml(folder, test_photogrammetry.BENT),
    "reality": lambda folder: test_photogrammetry.reality_csv(folder, test_photogrammetry.NONE),
    "bundler": test_photogrammetry.bundle,
    "panoptic-lifting": lambda folder: write_tiny_scene(folder, frames=3, size=(32, 24), masks="panoptic_lifting"),
    "pairs": lambda folder: test_label_images.write_pairs(folder, ("semantic", "instance")),
    "arrays": arrays,
    "detections": test_detections.write_stacks,
    "detection-pictures": test_detections.write_pictures,
    "coco-detections": lambda folder: coco_detections(folder, test_coco_detections.whole),
    "coco-polygons": lambda folder: coco_detections(folder, test_coco_detections.polygons),
    "detectron2": lambda folder: test_segment_maps.write_detectron2(folder, test_segment_maps.COCO_NUMBERS, {5}),
    "transformers": test_segment_maps.write_transformers,
    "sam2": test_tracks.write_palettes,
    "sam": test_tracks.write_pictures,
    "palette": test_tracks.write_palettes,
    "grounded-sam2": test_tracks.write_grounded,
}
OPTIONS: dict[str, dict[str, str]] = {
    "pairs": {"classes": "nyu40:1-40"},
    "arrays": {"classes": "nyu40"},
    "detections": {"classes": "coco"},
    "detection-pictures": {"mask_format": "detections"},
    "sam2": {"mask_format": "sam2"},
    "palette": {"mask_format": "palette", "classes": "coco"},
}
Sample = Callable[[str], Path]


@pytest.fixture(scope="session", name="sample")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Sample:
    """Gives the folder of a sample, which is written once."""
    written: dict[str, Path] = {}

    def of(name: str) -> Path:
        if name not in written:
            folder = tmp_path_factory.mktemp(name)
            WRITERS[name](folder)
            written[name] = folder
        return written[name]

    return of


@contextmanager
def with_content(path: Path, content: bytes | None) -> Iterator[None]:
    """The file with other content, or None: without it, for a while."""
    original = path.read_bytes() if path.exists() else None
    path.unlink(missing_ok=True) if content is None else path.write_bytes(content)
    try:
        yield
    finally:
        path.unlink(missing_ok=True) if original is None else path.write_bytes(original)


def opened(folder: Path, name: str) -> Scene:
    return open_scene(folder / "ai_001_001" if name == "hypersim" else folder, **OPTIONS.get(name, {}))


def look_into(folder: Path, name: str) -> None:
    with np.errstate(all="ignore"):
        describe(opened(folder, name))
