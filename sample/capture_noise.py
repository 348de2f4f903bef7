"""What a hand-held camera does to colour and poses: it amplifies, tints, blurs, leaves borders black, and drifts.

Every function is pure: the same values and the same random stream give the same result. ``depth_sensor.py`` does the
same for depth. Colour is linear light here, float32 [H, W, 3] with 1 = white; ``linear`` and ``srgb`` convert.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]
Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True)
class CaptureNoise:
    """How far a capture is from a rendering. Lengths over frames are correlation lengths; the rest is metres."""

    gain: float = 2.0
    """Exposure and white balance together brighten or darken linear light by no more than this."""
    exposure_frames: float = 10.0
    white_balance: float = 0.12
    """Largest change of a channel beside the exposure's."""
    white_balance_frames: float = 20.0
    blurred: float = 0.1
    """Share of the frames with motion blur."""
    blur_length: tuple[float, float] = (5.0, 11.0)
    """Pixels of a picture 640 wide."""
    border: tuple[float, float] = (0.01, 0.025)
    """Narrowest and widest black border, in shares of the width."""
    pose_shift: float = 0.005
    """Root mean square over the frames, metres."""
    pose_turn: float = 0.3
    """Root mean square over the frames, degrees."""
    pose_frames: float = 15.0
    depth_floor: float = 0.0012
    """Standard deviation of depth at ``depth_nearest``."""
    depth_growth: float = 0.0019
    """How it grows: times the square of the metres beyond ``depth_nearest``."""
    depth_nearest: float = 0.4
    depth_grain: float = 1.5
    """Over how many pixels of a depth image 320 wide its noise is correlated (the blur's standard deviation)."""
    focal_baseline: float = 43.5
    """Pixels times metres: a focal length of 580 and a baseline of 7.5 cm, as in the first Kinect."""
    disparity_step: float = 0.125
    """Pixels: what the sensor tells apart."""
    dark: tuple[float, float] = (0.006, 0.03)
    """Linear luminance at which nearly nothing, and at which everything comes back."""
    highlight: tuple[float, float] = (0.5, 0.15)
    """Linear luminance of a highlight, and how far it is above what surrounds it."""
    polished: float = 0.02
    """Share of the surfaces that mirror the sensor's light away."""
    polished_size: float = 0.3
    """Metres: about the size of such a patch."""
    grazing: tuple[float, float] = (0.1, 0.25)
    """Cosine between the line of sight and the normal at which nothing, and at which everything comes back."""
    reach: tuple[float, float] = (6.0, 8.0)
    """Metres: up to here everything, from here on nearly nothing comes back."""
    lost: float = 0.97
    """Chance of a hole where the causes above are at their worst."""
    hole_grain: float = 3.0
    """Over how many pixels of a depth image 320 wide a hole's outline is correlated."""
    edge: float = 0.04
    """Relative step of 1 / depth that counts as an edge."""
    flying: float = 0.4
    """Share of the pixels at an edge that mix both sides."""


def drift(count: int, channels: int, length: float, random: np.random.Generator) -> Floats:
    """Smooth random functions of the frame number, float64 [count, channels], about normal with deviation 1.

    Random Fourier features of a Gaussian kernel: hands, auto exposure and trackers err slowly, not frame by frame.
    """
    waves = 16
    frequencies = random.normal(size=(channels, waves)) / length
    phases = random.random((channels, waves)) * 2.0 * np.pi
    return np.cos(np.arange(count)[:, None, None] * frequencies + phases).sum(-1) * np.sqrt(2.0 / waves)


def colour_gains(count: int, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """What each frame's linear light is multiplied by, float64 [count, 3] (red, green, blue), within 1 / gain to gain.

    Auto exposure makes dark places bright and bright ones dark; automatic white balance does so for each channel.
    Both are logarithmic: one stop up is as likely as one down.
    """
    tint = np.log1p(noise.white_balance)
    exposures = np.tanh(drift(count, 1, noise.exposure_frames, random)) * (np.log(noise.gain) - tint)
    tints = np.tanh(drift(count, 3, noise.white_balance_frames, random)) * tint
    return np.exp(exposures + tints)


def blurred_frames(count: int, noise: CaptureNoise, random: np.random.Generator) -> dict[int, Floats]:
    """Motion in shares of the width, float64 [2] (right, down), of the frames that are blurred, by frame number.

    The hand's unrest is a line while the shutter is open: of any direction, and of ``blur_length``.
    """
    chosen = sorted(random.choice(count, round(noise.blurred * count), replace=False).tolist())
    lengths = random.uniform(*noise.blur_length, len(chosen)) / 640.0
    angles = random.uniform(0.0, np.pi, len(chosen))
    motions = lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
    return dict(zip(chosen, motions, strict=True))


def motion_blur(light: Pixels, motion: Floats) -> Pixels:
    """The mean of linear light [H, W, 3] over a straight motion, float64 [2] pixels, about where it was."""
    reach = int(np.ceil(np.abs(motion).max() / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for share in np.linspace(-0.5, 0.5, 64):
        x, y = motion * share + reach
        left, top = int(x), int(y)
        across, down = x - left, y - top
        kernel[top : top + 2, left : left + 2] += np.outer([1.0 - down, down], [1.0 - across, across])
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def border_mask(size: Size, noise: CaptureNoise, random: np.random.Generator) -> NDArray[np.bool_]:
    """The pixels that undistortion has nothing for, bool [H, W].

    Straightening a lens's curves moves the picture's edges inwards by a parabola of the place along the edge, another
    one on each side as lenses are not quite centred; a slight wave is the interpolation's.
    """
    width, height = size
    narrow, wide = noise.border[0] * width, noise.border[1] * width
    insets = []
    for along in (height, height, width, width):
        place = (np.arange(along) + 0.5) / along * 2.0 - 1.0
        start, bend, centre, wave, phase = random.random(5)
        curve = 0.3 * start + 0.6 * (0.5 + bend) * (place - 0.4 * (centre - 0.5)) ** 2
        curve += 0.1 * np.sin(2.0 * np.pi * ((2.0 + 3.0 * wave) * place + phase))
        insets.append(narrow + (wide - narrow) * curve.clip(0.0, 1.0))
    left, right, top, bottom = insets
    x, y = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    return (x < left[:, None]) | (width - x < right[:, None]) | (y < top) | (height - y < bottom)


def pose_errors(count: int, noise: CaptureNoise, random: np.random.Generator) -> tuple[Floats, Floats]:
    """What the tracker is wrong by: shifts float64 [count, 3] in metres, turns float64 [count, 3] (axis times radians).

    Low frequency along the path, as a tracker drifts and finds back; the root mean squares are those of ``noise``.
    """
    shifts = drift(count, 3, noise.pose_frames, random)
    turns = drift(count, 3, noise.pose_frames, random)
    return _with_rms(shifts, noise.pose_shift), _with_rms(turns, float(np.radians(noise.pose_turn)))


def _with_rms(values: Floats, target: float) -> Floats:
    """Vectors [count, 3] about their mean, which would only move the world, scaled to a root mean square length."""
    centred = values - values.mean(0)
    return centred * (target / max(float(np.sqrt((centred**2).sum(-1).mean())), 1e-9))


def misplaced(pose: Floats, shift: Floats, turn: Floats) -> Floats:
    """A camera-to-world pose, float64 [4, 4], shifted in the world and turned about the camera's own centre."""
    wrong = pose.copy()
    wrong[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(turn)[0]
    wrong[:3, 3] += shift
    return wrong


def linear(colour: NDArray[np.uint8]) -> Pixels:
    """Linear light of 8-bit sRGB (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[colour]


def srgb(light: Pixels) -> NDArray[np.uint8]:
    """8-bit sRGB of linear light; what is brighter than white is cut off, as a sensor's full wells are."""
    value = light.clip(0.0, 1.0)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1.0 / 2.4) - 0.055)
    return (curve * 255.0 + 0.5).astype(np.uint8)
