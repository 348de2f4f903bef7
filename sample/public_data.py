"""What the programs share that make a scene of public data: the command line, the scene's folder, its pictures."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


class BadInput(Exception):
    """What is wrong, where, and what to do about it."""

    def __init__(self, what: str, where: Path, fix: str) -> None:
        super().__init__(f"{what}: {where}. {fix}")


def run(make_scene: Callable[[Path, Path, int], int], about: str, data: str, every: int, closing: str) -> int:
    """The command line DATA OUT [--every N], and its exit code. ``make_scene`` gets these three and returns how
    many frames there are, or raises BadInput or OSError; ``about`` the program, ``data`` what DATA is,
    ``every`` the default, ``closing`` what is told in the end."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("data", type=Path, metavar="DATA", help=data)
    parser.add_argument("out", type=Path, metavar="OUT", help="scene folder to make")
    parser.add_argument("--every", type=int, default=every, metavar="N", help=f"take each N-th frame (default {every})")
    options = parser.parse_args()
    if options.every < 1:
        parser.error("--every takes a whole number from 1")
    try:
        frames = make_scene(options.data, options.out, options.every)
    except (BadInput, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{frames} frames in {options.out}; {closing}")
    return 0


@contextmanager
def new_scene(out: Path, folders: Iterable[str]) -> Iterator[None]:
    """Make the folders of a scene; nothing is left of them when what is done within breaks off.

    Raises BadInput when there is something already, OSError when they cannot be made.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadInput("is there already", out, "Give a folder that is new or empty.")
    try:
        for folder in folders:
            (out / folder).mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)  # it was new or empty
        raise


def write_image(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16], how: Sequence[int] = ()) -> None:
    """``how`` are OpenCV's parameters and values. Raises OSError."""
    if not cv2.imwrite(str(path), pixels, how):
        raise OSError(f"cannot be written: {path}. Choose a folder that you may write to, on a disk with space.")
