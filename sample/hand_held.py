"""Make a scene look hand-held: ``python sample/hand_held.py SCENE OUT [--seed N]``.

SCENE is a rendered scene, exact in colour, depth and poses. OUT shows it as a hand-held camera with a structured-light
sensor would: exposure and white balance drift, some frames are blurred, undistortion leaves black borders, poses are
slightly wrong, depth is coarse, noisy, quantised and full of holes. Ground truth, masks, split and intrinsics are
copied. ``hand_held.json`` lists what was done to each frame, ``capture_noise.CaptureNoise`` how much."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import capture_noise
import cv2
import numpy as np
from capture_noise import CaptureNoise, Floats, Pixels
from numpy.typing import NDArray
from shared import stream, write_image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from engine.errors import PlgsError
from engine.scene import Camera, Frame, open_scene

JPEG = (cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
"""Coarser JPEG rings up to 60 grey levels into the black border. This leaves 10 at most, and PNG none."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene folder, rendered or otherwise exact")
    parser.add_argument("out", type=Path, help="scene folder to make; an existing one is refused")
    parser.add_argument("--seed", type=int, default=0, help="different seeds give different faults (default 0)")
    options = parser.parse_args()
    try:
        print(write_hand_held(options.scene, options.out, options.seed))
    except (PlgsError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def write_hand_held(scene: Path, out: Path, seed: int, noise: CaptureNoise | None = None) -> str:
    """Write the folder ``out``; return a line about it. Raises PlgsError if it exists or is in ``scene``; OSError."""
    noise = noise or CaptureNoise()
    frames = open_scene(scene).frames
    _copy(scene, out)
    gains = capture_noise.colour_gains(len(frames), noise, stream(seed, "gains"))
    blurred = capture_noise.blurred_frames(len(frames), noise, stream(seed, "blur"))
    shifts, turns = capture_noise.pose_errors(len(frames), noise, stream(seed, "pose"))
    waves = capture_noise.polish_waves(noise, stream(seed, "polish"))
    for index, frame in enumerate(frames):
        colour = frame.read_colour(None)
        depth = sensed_depth(frame, capture_noise.linear(colour), waves, noise, seed)
        black = capture_noise.border_mask(frame.size, noise, stream(seed, "border"))
        hand_held = exposed(capture_noise.linear(colour), gains[index], blurred.get(index), black)
        pose = capture_noise.misplaced(frame.camera.camera_to_world, shifts[index], turns[index])
        is_jpeg = frame.colour_path.suffix.lower() in (".jpg", ".jpeg")
        write_image(out / "color" / frame.colour_path.name, hand_held[..., ::-1], JPEG if is_jpeg else ())
        write_image(out / "depth" / frame.depth_path.name, np.round(depth * 1000.0).clip(0, 65535).astype(np.uint16))
        np.savetxt(out / f"pose/{frame.name}.txt", pose, "%.9f")
    still = np.zeros(2)
    lines = []  # one for each frame
    for index, frame in enumerate(frames):
        fault = {"gains": gains[index].round(4).tolist(), "blur": blurred.get(index, still).round(5).tolist()}
        lines.append(" " + json.dumps({"frame": frame.name, **fault}))
    head, listed = f'"seed": {seed},\n"noise": {json.dumps(asdict(noise))}', ",\n".join(lines)
    (out / "hand_held.json").write_text(f'{{{head},\n"frames": [\n{listed}\n]}}\n', encoding="utf-8")
    return f"{len(frames)} frames in {out}"


def exposed(light: Pixels, gains: Floats, motion: Floats | None, black: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the picture, uint8 [H, W, 3], of linear light after the shutter's blur, amplification, clipping and
    undistortion. ``gains`` float64 [3], ``motion`` float64 [2] in widths or None, ``black`` [H, W]: borders."""
    if motion is not None:
        light = capture_noise.motion_blur(light, motion * light.shape[1])
    colour = capture_noise.srgb(light * gains.astype(np.float32))
    colour[black] = 0
    return colour


def sensed_depth(frame: Frame, light: Pixels, waves: Floats, noise: CaptureNoise, seed: int) -> Floats:
    """Return depth as the sensor measures it, float64 [H / 2, W / 2] metres, 0 = none. ``light`` is linear."""
    exact = capture_noise.half_size(frame.read_depth(None).astype(np.float64), noise)
    height, width = exact.shape
    camera = frame.camera.resized(width, height)
    rays, points = lines_of_sight(camera), camera.unproject(exact)
    seen = cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA)
    chance = capture_noise.chance_of_holes(exact, seen, rays, points=points, noise=noise, waves=waves)
    random = stream(seed, "depth", frame.name)
    mixed = capture_noise.flying_pixels(exact, noise, random)
    depth = capture_noise.quantised(capture_noise.noisy(mixed, noise, random), noise)
    depth[capture_noise.holes(chance, noise, random)] = 0.0
    return depth


def lines_of_sight(camera: Camera) -> Floats:
    """Return the ray of each pixel with z = 1 in the camera's axes, float64 [H, W, 3]."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)


def _copy(scene: Path, out: Path) -> None:
    """Copy the folder, including frames that nothing reads (without a pose, or in neither split)."""
    if out.exists():
        raise PlgsError("exists", "the output folder exists already", out, "Name a folder that does not exist yet.")
    if out.resolve().is_relative_to(scene.resolve()):
        raise PlgsError("inside-scene", "the output folder lies within the scene", out, "Name a folder elsewhere.")
    try:
        # Depth is written for the colour's lens, so it needs no lens of its own.
        shutil.copytree(scene, out, copy_function=shutil.copyfile, ignore=shutil.ignore_patterns("intrinsic_depth.txt"))
    except OSError as error:
        raise PlgsError("not-copied", f"the scene cannot be copied ({error})", out, "Check its disk.") from error


if __name__ == "__main__":
    sys.exit(main())
