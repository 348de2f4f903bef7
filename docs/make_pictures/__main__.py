"""The command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
from plgs.plgs_blender.results import LiftResult, read_result

from .blender import group_picture, matte_picture, shot_picture, write_camera
from .layers import layers_picture, mask_picture, strip_picture
from .meshes import catcher_picture, meshes_picture
from .sheets import Picture

PICTURES = Path(__file__).resolve().parent.parent / "pictures"
JPEG_QUALITY = 82

MAKERS: dict[str, Callable[[LiftResult], Picture]] = {
    "strip": strip_picture,
    "mask": mask_picture,
    "layers": layers_picture,
    "shot": shot_picture,
    "matte": matte_picture,
    "group": group_picture,
    "meshes": meshes_picture,
    "catcher": catcher_picture,
}


def save(name: str, picture: Picture) -> None:
    path = PICTURES / ("strip.jpg" if name == "strip" else f"passes_{name}.jpg")
    if not cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
        raise OSError(f"{path} cannot be written")
    print(f"{path}: {picture.shape[1]}x{picture.shape[0]}, {path.stat().st_size // 1000} kB")


def main(arguments: Sequence[str]) -> int:
    """The command line; its exit code."""
    parser = argparse.ArgumentParser(description="Make the pictures of docs/passes.md, and the strip of README.")
    parser.add_argument("what", nargs="+", choices=["camera", "all", *MAKERS], metavar="PICTURE")
    parser.add_argument("lift", type=Path, help="a finished lift of the sample")
    options = parser.parse_args(arguments)
    lift = options.lift.absolute()
    if "camera" in options.what:
        write_camera(lift)
        return 0
    for name in MAKERS if "all" in options.what else options.what:
        save(name, MAKERS[name](read_result(lift)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
