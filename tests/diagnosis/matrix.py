"""What a diagnosis says of faults that are planted one by one: ``python -m tests.diagnosis.matrix SCENE ...``.

Each scene has the present layout. docs/captures.md sums the table up.
"""

import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from engine.diagnosis import Diagnosis, diagnose, write_mended
from engine.errors import PlgsError
from engine.scene import open_scene
from tests.diagnosis.spoiling import depths, farther, intrinsics, poses, ray_lengths, rename, repeat

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
BACK = np.diag([-1.0, 1.0, -1.0, 1.0])
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Turns z to y."""


@dataclass(frozen=True)
class Fault:
    """``causes`` are right names for it."""

    plant: Callable[[Path], None]
    causes: tuple[str, ...]


def _focal(times: float) -> Callable[[Path], None]:
    factors = np.array([[times, 1, 1, 1], [1, times, 1, 1], [1] * 4, [1] * 4])
    return lambda folder: intrinsics(folder, lambda matrix: matrix * factors)


def _mirrored(folder: Path, *kinds: str) -> None:
    for kind in kinds:
        for path in sorted((folder / kind).iterdir()):
            cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, ::-1])


def _next_class(folder: Path) -> None:
    """As where one program counts classes from 0 and another from 1."""
    table = folder / "panoptic.json"
    content = json.loads(table.read_text())
    ids = sorted(each["id"] for each in content["categories"])
    following = dict(zip(ids, [*ids[1:], ids[0]], strict=True))
    for entry in content["annotations"]:
        for segment in entry["segments_info"]:
            segment["category_id"] = following[segment["category_id"]]
    table.write_text(json.dumps(content))


def _drifted(folder: Path, direction: list[float], share: Callable[[int, int], float]) -> None:
    """Move a pose by 30 cm times the ``share`` of its number and of how many there are."""
    count = len(list((folder / "pose").iterdir()))
    away = np.zeros((4, 4))
    away[:3, 3] = 0.3 * np.array(direction) / np.linalg.norm(direction)
    poses(folder, lambda n, pose: pose + away * share(n, count))


def _poses_of_the_next(folder: Path) -> None:
    original = [np.loadtxt(path) for path in sorted((folder / "pose").iterdir())]
    poses(folder, lambda n, pose: original[min(n + 1, len(original) - 1)])


def _of_the_next(kind: str) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        paths = sorted((folder / kind).iterdir())
        contents = [path.read_bytes() for path in paths]
        for path, content in zip(paths, [*contents[1:], contents[0]], strict=True):
            path.write_bytes(content)

    return plant


def _masks_of_others(folder: Path) -> None:
    paths = sorted((folder / "panoptic").iterdir())
    table = json.loads((folder / "panoptic.json").read_text())
    entries = {entry["file_name"]: entry for entry in table["annotations"]}
    far = len(paths) // 2
    for path in paths[4:7]:
        other = paths[paths.index(path) + far]
        shutil.copyfile(other, path)
        entries[path.name]["segments_info"] = entries[other.name]["segments_info"]
    (folder / "panoptic.json").write_text(json.dumps(table))


def _repeated(folder: Path) -> None:
    names = sorted(path.stem for path in (folder / "pose").iterdir())
    repeat(folder, names[10], instead_of=names[11])


def _shuffled(folder: Path) -> None:
    count = len(list((folder / "pose").iterdir()))
    rename(folder, np.random.default_rng(0).permutation(count).tolist())


FAULTS: dict[str, Fault] = {
    "world-to-camera poses": Fault(lambda f: poses(f, lambda _, p: np.linalg.inv(p)), ("inverted poses",)),
    "OpenGL axes": Fault(lambda f: poses(f, lambda _, p: p @ FLIP), ("wrong axes",)),
    "both": Fault(lambda f: poses(f, lambda _, p: np.linalg.inv(p @ FLIP)), ("inverted poses and wrong axes",)),
    "poses in centimetres": Fault(lambda f: poses(f, lambda _, p: farther(p, 100.0)), ("pose unit",)),
    "poses in millimetres": Fault(lambda f: poses(f, lambda _, p: farther(p, 1000.0)), ("pose unit",)),
    "poses a tenth too far": Fault(lambda f: poses(f, lambda _, p: farther(p, 1.1)), ("pose unit", "depth unit")),
    "poses of the next frame": Fault(_poses_of_the_next, ("frames off",)),
    "depth in 5000 steps per metre": Fault(lambda f: depths(f, lambda d: d * 5.0), ("depth unit",)),
    "depth in centimetres": Fault(lambda f: depths(f, lambda d: d * 0.1), ("depth unit",)),
    "depth along the ray": Fault(lambda f: depths(f, lambda d: d * ray_lengths(f, d.shape)), ("ray depth",)),
    "depth of the next frame": Fault(_of_the_next("depth"), ("frames off",)),
    "depth moved by 5 pixels": Fault(lambda f: depths(f, lambda d: np.roll(d, 5, 1)), ("colour-to-depth shift",)),
    "depth mirrored": Fault(lambda f: _mirrored(f, "depth"), ("mirrored images",)),
    "colour mirrored": Fault(lambda f: _mirrored(f, "color"), ("mirrored colour",)),
    "colour, depth and masks mirrored": Fault(
        lambda f: _mirrored(f, "color", "depth", "panoptic"), ("mirrored images",)
    ),
    "colour of the next frame": Fault(_of_the_next("color"), ("colour of other frames",)),
    "intrinsics of half the size": Fault(
        lambda f: intrinsics(f, lambda k: k * np.array([[0.5] * 4, [0.5] * 4, [1] * 4, [1] * 4])),
        ("intrinsics of another size",),
    ),
    "focal length a fifth too long": Fault(_focal(1.2), ("focal length",)),
    "principal point 20 pixels off": Fault(
        lambda f: intrinsics(f, lambda k: k + np.array([[0, 0, 20, 0], [0] * 4, [0] * 4, [0] * 4])),
        ("principal point",),
    ),
    "y is up": Fault(lambda f: poses(f, lambda _, p: Y_UP @ p), ("up direction",)),
    "one pose out of place": Fault(
        lambda f: poses(f, lambda n, p: p @ BACK if n == 9 else p), ("frames out of place",)
    ),
    "half the scan 30 cm off": Fault(
        lambda f: _drifted(f, [1, 1, 1], lambda n, count: n >= count // 2), ("drift", "parts apart")
    ),
    "drift up to 30 cm": Fault(lambda f: _drifted(f, [1, 0, 0], lambda n, count: n / count), ("drift",)),
    "one frame repeated": Fault(_repeated, ("repeated frames",)),
    "frames shuffled": Fault(_shuffled, ("unsorted frames",)),
    "masks of other frames, three": Fault(_masks_of_others, ("contradicting masks",)),
    "class ids off by one": Fault(_next_class, ("class table",)),
}
NOTES = {"exposure"}
"""Causes that say nothing about a fault planted here."""


@dataclass(frozen=True)
class Outcome:
    """What was said of a scene: the causes, the "wrong" ones first, and what became of the mend."""

    causes: tuple[str, ...]
    wrong: tuple[str, ...]
    mend: str

    def cell(self, fault: Fault) -> str:
        """As it stands in the table."""
        named = [cause for cause in self.causes if cause not in NOTES]
        right = named[:1] and named[0] in fault.causes
        said = ", ".join(named) or "nothing"
        return f"{'yes' if right else 'no'}: {said}{self.mend and f' ({self.mend})'}"

    def is_right(self, fault: Fault) -> bool:
        return bool({*self.causes} & {*fault.causes})

    @property
    def is_noticed(self) -> bool:
        return any(cause not in NOTES for cause in self.causes)


def outcome_of(scene: Path, original: Path) -> Outcome:
    """Diagnose a spoilt copy of a scene, and mend it. A refusal to open it is its only cause."""
    try:
        opened = open_scene(scene)
        found = diagnose(opened)
    except PlgsError as error:
        return Outcome((error.what,), (error.what,), "refused")
    causes = tuple(finding.cause for finding in found.findings)
    wrong = tuple(finding.cause for finding in found.findings if finding.severity == "wrong")
    return Outcome(causes, wrong, _mend(opened, found, scene.with_name("mended"), original))


def _mend(scene: object, found: Diagnosis, out: Path, original: Path) -> str:
    if not found.mending.is_needed:
        return ""
    why = write_mended(scene, found, out)  # type: ignore[arg-type]
    if why is not None:
        return "not mended"
    before, after = _agreement(original), _agreement(out)
    return "mended" if after >= 0.9 * before else "harmed"


@cache
def _agreement(scene: Path) -> float:
    """The share of the seen points that agree."""
    found = diagnose(open_scene(scene)).agreement
    return 0.0 if found is None else found.share


def planted(scene: Path, fault: Fault, folder: Path) -> Outcome:
    """Plant a fault in a copy in ``folder``, and look at it."""
    copy = folder / "spoilt"
    shutil.copytree(scene, copy)
    fault.plant(copy)
    return outcome_of(copy, scene)


def main(scenes: Sequence[str]) -> int:
    paths = [Path(scene) for scene in scenes]
    for scene in paths:
        clean = diagnose(open_scene(scene))
        print(f"{scene.name} as it is: {[(each.cause, each.severity) for each in clean.findings]}", file=sys.stderr)
    print(f"| planted | {' | '.join(scene.name for scene in paths)} |")
    print(f"|---|{'---|' * len(paths)}")
    noticed = right = harmed = 0
    for name, fault in FAULTS.items():
        cells = []
        for scene in paths:
            with tempfile.TemporaryDirectory() as folder:
                outcome = planted(scene, fault, Path(folder))
            cells.append(outcome.cell(fault))
            noticed += outcome.is_noticed
            right += outcome.is_right(fault)
            harmed += outcome.mend == "harmed"
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    count = len(FAULTS) * len(paths)
    print(f"\n{count} planted: {noticed} noticed, {right} with the right cause, {harmed} mends did harm.")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
