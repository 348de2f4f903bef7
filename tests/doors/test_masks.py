"""What docs/masks.md promises, on masks that other programs write, or as their documentation shows them."""

import csv
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.command_line.main import main
from engine.scene import open_scene
from tests.commands import answer_of
from tests.doors.terminal import ROOT, Terminal
from tests.raises_key import worded
from tests.scene.mask_formats import test_detections as detections
from tests.scene.mask_formats import test_label_images as label_images
from tests.scene.mask_formats import test_tracks as sam_2
from tests.scene.mask_formats.labelled_room import (
    COCO_NAMES,
    COCO_NUMBERS,
    NAMES,
    THINGS,
    Truth,
    check_on_room,
    tracks,
    write_frames,
)
from tests.scene.mask_formats.test_segment_maps import write_detectron2
from tests.scene.test_numbering import TRAFFIC, in_table, write_labels
from tests.segment.tiny_mask2former import save_tiny_mask2former
from tests.tiny_scene import CATEGORIES, write_tiny_scene

LIFT = ".venv/bin/python -m engine lift SCENE --masks MASKS --detections coco_instances_results.json -o OUT"
SEGMENT = (
    ".venv/bin/python -m engine segment SCENE --download "
    "[--model facebook/mask2former-swin-large-coco-panoptic | FOLDER] [-o FOLDER] [--frames auto]"
)
QUICK = ("--steps", "5", "--set", "warm_start=false")
CHAIRS = {1: "", 2: "", 3: "", 5: "chair", 13: ""}
"""What is left of the room's classes where masks show chairs alone."""


def runs(mask: np.ndarray) -> dict[str, Any]:
    """Run lengths as pycocotools packs them."""
    rle_tools = pytest.importorskip("pycocotools.mask")
    packed = rle_tools.encode(np.asfortranarray(mask, np.uint8))
    return {"size": packed["size"], "counts": packed["counts"].decode()}


def chairs(truths: list[Truth]) -> Iterator[tuple[str, np.ndarray]]:
    for truth in truths:
        yield from ((truth.name, region) for kind, _, region in truth.regions() if kind == 5)


def panoptic_api(masks: Path, truths: list[Truth]) -> None:
    """cocodataset/panopticapi: a pixel's id is R + 256 G + 256² B; the picture is written by Pillow."""
    image = pytest.importorskip("PIL.Image")
    annotations = []
    (masks / "panoptic").mkdir()
    for number, truth in enumerate(truths):
        ids, segments = np.zeros((*truth.semantic.shape, 3), np.uint8), []
        for kind, one, region in truth.regions():
            identity = 1 + kind + 300 * one + 70000 * (number % 2)
            ids[region] = identity % 256, identity // 256 % 256, identity // 65536
            segments.append({"id": identity, "category_id": kind, "iscrowd": 0, "area": int(region.sum())})
        image.fromarray(ids).save(masks / "panoptic" / f"{truth.name}.png")
        annotations.append({"image_id": number, "file_name": f"{truth.name}.png", "segments_info": segments})
    images = [{"id": number, "file_name": f"{truth.name}.jpg"} for number, truth in enumerate(truths)]
    content = {"images": images, "annotations": annotations, "categories": CATEGORIES}
    (masks / "panoptic.json").write_text(json.dumps(content))


def detectron2_results(masks: Path, truths: list[Truth]) -> None:
    """COCOEvaluator's coco_instances_results.json: categories by the data set's ids, images by numbers."""
    found = [
        {"image_id": int(name), "category_id": 62, "bbox": [0, 0, 9, 9], "score": 0.98, "segmentation": runs(region)}
        for name, region in chairs(truths)
    ]
    (masks / "coco_instances_results.json").write_text(json.dumps(found))


def ultralytics_predictions(masks: Path, truths: list[Truth]) -> None:
    """`yolo val save_json=True`: COCO's results with the stems of the pictures."""
    found = [
        {"image_id": name, "file_name": f"{name}.jpg", "category_id": 62, "bbox": [0.0, 0.0, 9.0, 9.0],
         "score": 0.87654, "segmentation": runs(region)}
        for name, region in chairs(truths)
    ]  # fmt: skip
    (masks / "predictions.json").write_text(json.dumps(found))


def coco_instances(masks: Path, truths: list[Truth]) -> None:
    """COCO's annotations with polygons, by OpenCV's contours."""
    annotations = []
    for name, region in chairs(truths):
        outlines = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        polygons = [each.ravel().tolist() for each in outlines if len(each) > 2]
        annotations.append({"id": len(annotations) + 1, "image_id": int(name), "category_id": 5, "iscrowd": 0,
                            "segmentation": polygons})  # fmt: skip
    images = [{"id": int(t.name), "file_name": f"{t.name}.png", "width": 64, "height": 48} for t in truths]
    content = {"images": images, "annotations": annotations, "categories": [{"id": 5, "name": "chair"}]}
    (masks / "instances.json").write_text(json.dumps(content))


def transformers_panoptic(masks: Path, truths: list[Truth]) -> None:
    """What transformers' own post_process_panoptic_segmentation returns, and the config that it saves."""
    transformers = pytest.importorskip("transformers")
    import torch

    labels = {number: COCO_NAMES.get(kind, "") for kind, number in COCO_NUMBERS.items()}
    names = {number: labels.get(number, f"class {number}") for number in range(133)}
    config = transformers.Mask2FormerConfig(id2label=names, label2id={name: number for number, name in names.items()})
    config.save_pretrained(masks)
    for truth in truths:
        regions = list(truth.regions())
        classes = torch.full((1, len(regions), 134), -20.0)
        pixels = torch.stack([torch.from_numpy(region) for *_, region in regions])[None].float() * 40 - 20
        for query, (kind, *_) in enumerate(regions):
            classes[0, query, COCO_NUMBERS[kind]] = 20.0
        outputs = transformers.models.mask2former.modeling_mask2former.Mask2FormerForUniversalSegmentationOutput(
            class_queries_logits=classes, masks_queries_logits=pixels
        )
        network = transformers.Mask2FormerImageProcessorPil(num_labels=133)
        (found,) = network.post_process_panoptic_segmentation(outputs, target_sizes=[truth.semantic.shape])
        np.save(masks / f"{truth.name}.npy", found["segmentation"].numpy())
        (masks / f"{truth.name}.json").write_text(json.dumps({"segments_info": found["segments_info"]}))


def opencv_label_images(masks: Path, truths: list[Truth]) -> None:
    """A script of the user's: classes of ADE20K's networks, counted from 0."""
    ade = {1: 0, 2: 3, 3: 10, 5: 19, 13: 5}
    for truth in truths:
        classes = np.vectorize(ade.__getitem__)(truth.semantic).astype(np.uint8)
        for name, values in (("semantic", classes), ("instance", truth.instance.astype(np.uint16))):
            (masks / name).mkdir(exist_ok=True)
            cv2.imwrite(str(masks / name / f"{truth.name}.png"), values)


def scannet_filt(masks: Path, truths: list[Truth]) -> None:
    """ScanNet's label-filt and instance-filt: raw ids of 16 bits, instances of 8 bits."""
    raw = {1: 1, 2: 3, 3: 7, 5: 2, 13: 41}
    for truth in truths:
        classes = np.vectorize(raw.__getitem__)(truth.semantic).astype(np.uint16)
        for name, values in (("label-filt", classes), ("instance-filt", truth.instance.astype(np.uint8))):
            (masks / name).mkdir(exist_ok=True)
            cv2.imwrite(str(masks / name / f"{truth.name}.png"), values)


def sav_masklets(masks: Path, truths: list[Truth]) -> None:
    """SA-V: for each frame of a video the runs of its objects, always in one order."""
    masklets = [[runs(truth.instance == number) for number in (1, 2)] for truth in truths]
    (masks / "video.json").write_text(json.dumps({"masklet": masklets}))


def panoptic_lifting(folder: Path) -> list[Truth]:
    write_tiny_scene(folder, 3, masks="panoptic_lifting", ground_truth=False)
    return write_frames(folder)[1]


Writer = Callable[[Path], list[Truth]]


def of_masks(write: Callable[[Path, list[Truth]], None]) -> Writer:
    """``write`` writes what it knows of the frames into the folder `masks` of the room."""

    def room(folder: Path) -> list[Truth]:
        _, truths = write_frames(folder)
        (folder / "masks").mkdir()
        write(folder / "masks", truths)
        return truths

    return room


NAMED = detections.SEEN | {3: "cabinet"}
SEEN_THINGS, DETECTRON2 = {"refrigerator", "chair"}, ("pred_masks", "pred_classes", "scores")
OBJECTS, GROUNDED = sam_2.OBJECTS, sam_2.OBJECTS | {3: "cabinet", 5: "kitchen chair."}
KINDS: list[tuple[str, Writer, str | None, dict[int, str], set[str]]] = [
    ("coco", of_masks(panoptic_api), None, NAMES, THINGS),
    ("coco-detections", of_masks(detectron2_results), "coco:90", CHAIRS, {"chair"}),
    ("coco-detections", of_masks(ultralytics_predictions), "coco:90", CHAIRS, {"chair"}),
    ("coco-detections", of_masks(coco_instances), None, CHAIRS, {"chair"}),
    ("coco-detections", of_masks(sav_masklets), None, OBJECTS, {"object"}),
    ("panoptic-lifting", panoptic_lifting, None, NAMES, {"chair"}),
    ("transformers", of_masks(transformers_panoptic), None, COCO_NAMES, {"chair"}),
    ("detectron2", lambda at: write_detectron2(at, COCO_NUMBERS, {5}), "coco", COCO_NAMES | {0: ""}, {"chair"}),
    ("sam2", sam_2.write_object_folders, None, OBJECTS, {"object"}),
    ("sam2 named", sam_2.write_palettes, None, OBJECTS, {"object"}),
    ("grounded-sam2", sam_2.write_grounded, None, GROUNDED, {"cabinet", "kitchen chair."}),
    ("pairs", of_masks(opencv_label_images), "ade20k:0-149", NAMES, THINGS),
    ("pairs", of_masks(scannet_filt), "scannet", NAMES, THINGS),
    ("palette named", label_images.write_palettes, "ade20k", NAMES | {0: ""}, set()),
    ("detections", detections.write_stacks, "coco", detections.SEEN, SEEN_THINGS),
    ("detections", lambda at: detections.write_stacks(at, keys=DETECTRON2), "coco", detections.SEEN, SEEN_THINGS),
    ("detections", lambda at: detections.write_stacks(at, as_names=True), None, NAMED, THINGS),
    ("detections named", detections.write_pictures, None, NAMED, THINGS),
    ("detections", lambda at: detections.write_tracks(at, detections.SAM_3, names=True), None, NAMED, THINGS),
    ("arrays", label_images.write_classes, "nyu40", NAMES, THINGS),
    ("arrays", label_images.write_probabilities, "nyu40", NAMES, set()),
]
"""A kind of masks ("named" where its files could be those of another kind), its writer, the class table that the user
names, the names of the room's classes, and its things."""


@pytest.mark.parametrize(("kind", "write", "table", "names", "things"), KINDS)
def test_every_mask_format_shows_the_classes_and_objects_of_the_room(
    kind: str, write: Writer, table: str | None, names: dict[int, str], things: set[str], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    kind, _, is_named = kind.partition(" ")
    truths = write(tmp_path)
    options = [*(["--classes", table] if table else []), *(["--mask-format", kind] if is_named else [])]
    told = answer_of(capsys, "inspect", tmp_path, *options)
    shares = {each["name"]: each["share"] for each in told["classes"]}
    pixels = np.stack([truth.semantic for truth in truths])
    for name in {*names.values()} - {""}:
        wanted = np.isin(pixels, [number for number, each in names.items() if each == name]).mean()
        assert shares.get(name, 0.0) == pytest.approx(wanted, abs=0.02)
    place = tmp_path if kind == "panoptic-lifting" else tmp_path / "masks"
    named = open_scene(tmp_path, place, classes=table, mask_format=kind)
    if not (place / "instances.json").exists():  # polygons do not keep every pixel
        check_on_room(named, truths, names, frozenset(things))
    if kind in ("sam2", "grounded-sam2") or (place / "video.json").exists():
        assert sorted(len(each - {None}) for each in tracks(named, truths).values()) == [1, 1], "one in all frames"


def test_folders_of_sam_masks_give_objects_and_warn_that_classes_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As segment-anything's scripts/amg.py writes them: a folder per picture, <k>.png and metadata.csv."""
    room, truths = write_frames(tmp_path / "room")
    head = "id,area,bbox_x0,bbox_y0,bbox_w,bbox_h,point_input_x,point_input_y,predicted_iou,stability_score"
    head += ",crop_box_x0,crop_box_y0,crop_box_w,crop_box_h"
    for truth in truths:
        (tmp_path / "masks" / truth.name).mkdir(parents=True)
        with (tmp_path / "masks" / truth.name / "metadata.csv").open("w", newline="") as file:
            file.write(f"{head}\n")
            for k, (*_, region) in enumerate(truth.regions()):
                csv.writer(file).writerow([k, region.sum(), *(9 * [1]), 0, 0, 64, 48][:14])
                cv2.imwrite(str(tmp_path / "masks" / truth.name / f"{k}.png"), region * np.uint8(255))
    told = answer_of(capsys, "inspect", room, "--masks", tmp_path / "masks")
    counts = sorted(len(list(truth.regions())) for truth in truths)
    assert told["segments_per_frame"][0] == counts[0] and told["segments_per_frame"][2] == counts[-1]
    doubtful = [each["reason"] for each in told["inferred"] if each["is_doubtful"]]
    assert any("number objects and have no classes" in reason for reason in doubtful), told["inferred"]


def test_a_sam_2_object_number_is_one_object_in_all_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As sam2's vos_inference.py writes them: Pillow's palette pictures."""
    image = pytest.importorskip("PIL.Image")
    room, truths = write_frames(tmp_path / "room")
    (tmp_path / "masks").mkdir()
    for truth in truths:
        picture = image.fromarray(truth.instance.astype(np.uint8))
        picture.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0] + 756 * [0])
        picture.save(tmp_path / "masks" / f"{truth.name}.png")
    (tmp_path / "masks/classes.toml").write_text('[[class]]\nid = 1\nname = "chair"\nthing = true\n')
    options = ["--masks", tmp_path / "masks", "--mask-format", "sam2"]
    told = answer_of(capsys, "inspect", room, *options)
    shares = {each["name"]: each["share"] for each in told["classes"]}
    wanted = np.stack([truth.instance for truth in truths]) == 1
    assert shares["chair"] == pytest.approx(wanted.mean(), abs=1e-6), "rows with id name single objects"


@pytest.mark.parametrize("name", ["0000.pkl", "0000.pt", "0000.ptz"])
def test_pickled_masks_are_never_read(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room, _ = write_frames(tmp_path / "room")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / name).write_bytes(b"cos\nsystem\n(S'touch stolen'\ntR.")
    assert main(["inspect", str(room), "--masks", str(tmp_path / "masks")]) == 2
    assert name.rpartition(".")[2] in capsys.readouterr().err and not Path("stolen").exists()


def test_classes_toml_names_merges_and_drops_classes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room, truths = write_frames(tmp_path / "room")
    (tmp_path / "masks").mkdir()
    panoptic_api(tmp_path / "masks", truths)
    (tmp_path / "masks/classes.toml").write_text(
        '[[class]]\nname = "cabinet"\ninto = "furniture"\n[[class]]\nname = "chair"\ninto = "furniture"\n'
        'colour = "#c8a064"\n[[class]]\nname = "ceiling"\ninto = "void"\n'
    )
    told = answer_of(capsys, "inspect", room, "--masks", tmp_path / "masks")
    names = {each["name"] for each in told["classes"]}
    pixels = np.stack([truth.semantic for truth in truths])
    shares = {each["name"]: each["share"] for each in told["classes"]}
    assert {"furniture", "wall", "floor"} == names
    assert shares["furniture"] == pytest.approx(np.isin(pixels, [3, 5]).mean(), abs=1e-3)
    for frame, truth in zip(open_scene(room, tmp_path / "masks").frames, truths, strict=True):
        things = [one for one in frame.mask().segments if one.is_thing]
        assert len(things) == len(np.unique(truth.instance[truth.instance > 0])), "two objects stay two"


def test_the_classes_toml_printed_in_the_docs_works(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs/masks.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    truths = write_labels(tmp_path, COCO_NUMBERS, void=255)
    (tmp_path / "masks/classes.toml").write_text(block)
    told = answer_of(capsys, "inspect", tmp_path)
    shares = {each["name"]: each["share"] for each in told["classes"]}
    pixels = np.stack([truth.semantic for truth in truths])
    wanted = {name: (pixels == number).mean() for number, name in (NAMES | {5: "sofa"}).items()}
    assert shares == pytest.approx({name: share for name, share in wanted.items() if share}, abs=1e-4)
    assert told["void_share"] == pytest.approx((pixels == 0).mean(), abs=1e-4)
    (sofa,) = (each for each in open_scene(tmp_path).classes.categories if each.name == "sofa")
    assert sofa.is_thing and tuple(sofa.colour) == (0xC8, 0xA0, 0x64)


OF_TABLES = {"coco": COCO_NAMES, "cityscapes": TRAFFIC, "nyu13": NAMES | {3: "furniture"}}
"""The room's classes by a table's names, where they are not its own."""


def named_on_the_page() -> list[str]:
    """All that the page says that ``--classes`` takes."""
    page = (ROOT / "docs/masks.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `([a-z0-9]+:[\d-]+)`(?:, `([a-z0-9]+:[\d-]+)`)? \|", page, re.MULTILINE)
    tables = re.findall(r"--classes ([a-z0-9|]+)`", page)[0].split("|")
    return sorted({*tables, *(each for both in found for each in both if each)})


@pytest.mark.parametrize("table", named_on_the_page())
def test_naming_a_class_table_decides_what_mask_numbers_mean(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = OF_TABLES.get(table.partition(":")[0], NAMES)
    truths = write_labels(tmp_path, in_table(table, names), void=255)
    told = answer_of(capsys, "inspect", tmp_path, "--classes", table)
    pixels = np.stack([truth.semantic for truth in truths])
    wanted = {name: (pixels == number).mean() for number, name in names.items() if (pixels == number).any()}
    assert {each["name"]: each["share"] for each in told["classes"]} == pytest.approx(wanted, abs=1e-4)
    doubts = [each for each in told["inferred"] if each["is_doubtful"] and each["about"] == "numbering"]
    assert not doubts or ":" not in table


@pytest.mark.slow
def test_a_lift_accepts_detections_together_with_masks(shell: Terminal, tmp_path: Path) -> None:
    """pycocotools' runs in detectron2's file; the log says whether masks are weak, and detections vote."""
    room = write_tiny_scene(shell.folder / "room", 6, masks="none")
    with_masks = write_tiny_scene(tmp_path / "masked", 6)
    truths = write_frames(tmp_path / "truth", 6)[1]
    detectron2_results(shell.folder, truths)
    (shell.folder / "classes.toml").write_text('table = "coco:90"\n')  # as the page says for a file without names
    shell.run(LIFT, SCENE=room.name, MASKS=with_masks / "panoptic.json", OUT="out", more=QUICK)
    log = (shell.folder / "out/log.txt").read_text()
    assert "the masks are good" in log and (shell.folder / "out/result/manifest.json").is_file()


def test_segment_writes_coco_panoptic_masks_and_never_overwrites_masks_of_others(
    shell: Terminal, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a network in a folder, as transformers saves one."""
    pytest.importorskip("transformers")
    assert SEGMENT.startswith(".venv/bin/python -m engine segment SCENE --download")
    write_tiny_scene(shell.folder / "room", 2, masks="none", ground_truth=False)
    save_tiny_mask2former(shell.folder / "network")
    shell.run(".venv/bin/python -m engine segment SCENE --model FOLDER", SCENE="room", FOLDER="network")
    told = answer_of(capsys, "inspect", shell.folder / "room")
    assert told["mask_sizes"] == [[[64, 48], 2]]
    before = {path: path.read_bytes() for path in (shell.folder / "room/panoptic").iterdir()}
    other = save_tiny_mask2former(shell.folder / "other", sure=20.0)
    command = ".venv/bin/python -m engine segment SCENE --model FOLDER"
    assert worded("other-masks").search(shell.run(command, code=2, SCENE="room", FOLDER=other))
    assert {path: path.read_bytes() for path in (shell.folder / "room/panoptic").iterdir()} == before


def test_segment_makes_masks_of_a_few_frames_then_of_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("transformers")
    room = write_tiny_scene(tmp_path / "room", 40, (32, 24), masks="none", ground_truth=False)
    network, masks = save_tiny_mask2former(tmp_path / "network", sure=20.0), tmp_path / "made"
    segment = ["segment", str(room), "--model", str(network), "-o", str(masks)]
    assert main([*segment, "--frames", "auto"]) == 0
    said = capsys.readouterr().err
    chosen = int(re.findall(r"Making masks of (\d+) of 40 frames, in about", said)[0])
    assert 5 < chosen < 40 and "licence" in said, "the others see what these see"
    made = json.loads((masks / "panoptic/made_by.json").read_text())
    assert made["model"] == str(network) and "licence" in made

    def shown() -> dict[str, bytes]:
        return {
            frame.name: (masks / f"panoptic/{frame.name}.png").read_bytes()
            for frame in open_scene(room, masks).frames if frame.mask().segments
        }  # fmt: skip

    before = shown()
    assert len(before) == chosen, "the others have empty masks"
    assert main([*segment, "--frames", "all"]) == 0
    assert len(shown()) == 40 and before.items() <= shown().items()
