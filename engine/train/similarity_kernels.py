"""The kernels behind ``similarity``: SSIM, L1 and the gradient of both, one strip of rows at a time.

Rows stream through: blurred along the row, they wait in a ring for the ten others that the blur across rows needs;
SSIM's three partial derivatives of that row then go the same way back. So the working set stays in the processor's
cache, where pictures of every intermediate would not. Strips overlap by twice the window's reach, and which rows a
strip has depends on the picture alone: the sums have the same bits whatever the number of threads.

Pictures are float32 [H, 3 W]: the three channels of a pixel stand side by side, its neighbours three further.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..machine.compiled import Array, contracted, contracted_parallel_kernel

WINDOW, SIGMA = 11, 1.5
REACH = WINDOW // 2
CHANNELS = 3
MARGIN = REACH * CHANNELS
"""Zeros on either side of a row that is blurred."""
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
STRIP_ROWS = 48

_WEIGHTS = [math.exp(-(offset**2) / (2 * SIGMA**2)) for offset in range(REACH + 1)]
WEIGHTS = [weight / (2 * sum(_WEIGHTS) - _WEIGHTS[0]) for weight in _WEIGHTS]
"""The window's weights from its middle outwards."""
W0, W1, W2, W3, W4, W5 = (np.float32(weight) for weight in WEIGHTS)
TWO, ONE, ZERO = np.float32(2), np.float32(1), np.float32(0)


def strip_count(height: int) -> int:
    return -(-height // STRIP_ROWS)


def scratch_size(length: int) -> int:
    """Floats of scratch of one worker for rows of ``length``: three padded rows, six plain ones, two rings."""
    return 3 * (length + 2 * MARGIN) + (6 + 2 * 3 * WINDOW) * length


@contracted
def blur_along(padded: Array, out: Array) -> None:
    """A row [L + 2 MARGIN] with its zeros, blurred along itself to [L]."""
    for i in range(len(out)):
        near = W0 * padded[i + 15] + W1 * (padded[i + 12] + padded[i + 18]) + W2 * (padded[i + 9] + padded[i + 21])
        far = W3 * (padded[i + 6] + padded[i + 24]) + W4 * (padded[i + 3] + padded[i + 27])
        out[i] = near + (far + W5 * (padded[i] + padded[i + 30]))


@contracted
def blur_across(ring: Array, row: int, out: Array) -> None:
    """Row ``row`` of the picture whose rows around it wait in ``ring`` [WINDOW, L], each at its number modulo that."""
    a, b, c = ring[(row + 6) % WINDOW], ring[(row + 7) % WINDOW], ring[(row + 8) % WINDOW]
    d, e, f = ring[(row + 9) % WINDOW], ring[(row + 10) % WINDOW], ring[(row + 11) % WINDOW]
    g, h, k = ring[(row + 12) % WINDOW], ring[(row + 13) % WINDOW], ring[(row + 14) % WINDOW]
    m, n = ring[(row + 15) % WINDOW], ring[(row + 16) % WINDOW]
    for i in range(len(out)):
        near = W0 * f[i] + W1 * (e[i] + g[i]) + W2 * (d[i] + h[i])
        out[i] = near + (W3 * (c[i] + k[i]) + W4 * (b[i] + m[i]) + W5 * (a[i] + n[i]))


@contracted
def moments_along(image: Array, photo: Array, padded: Array, ring: Array, slot: int) -> None:
    """A row of the image, of its square and of its product with the photo, blurred along into their rings."""
    value, square, product = padded[0, MARGIN:], padded[1, MARGIN:], padded[2, MARGIN:]
    for i in range(len(image)):
        value[i] = image[i]
    for i in range(len(image)):
        square[i] = image[i] * image[i]
    for i in range(len(image)):
        product[i] = image[i] * photo[i]
    for moment in range(3):
        blur_along(padded[moment], ring[moment, slot])


@contracted
def similarity_row(blurred: Array, photo_mean: Array, photo_variance: Array, ssim: Array, padded: Array) -> None:
    """SSIM [L] of a row from its ``blurred`` moments [3, L], and its derivatives by these into ``padded``."""
    mean, square, product = blurred[0], blurred[1], blurred[2]
    by_mean, by_square, by_product = padded[0, MARGIN:], padded[1, MARGIN:], padded[2, MARGIN:]
    for i in range(len(ssim)):
        x, y = mean[i], photo_mean[i]
        luminance, structure = TWO * x * y + C1, TWO * (product[i] - x * y) + C2
        first = ONE / (x * x + y * y + C1)
        second = ONE / (square[i] - x * x + photo_variance[i] + C2)
        scale = first * second
        value = luminance * structure * scale
        ssim[i] = value
        by_square[i] = -value * second
        by_product[i] = TWO * luminance * scale
        by_mean[i] = TWO * (y * (structure - luminance) * scale + x * value * (second - first))


@contracted
def gradient_row(
    image: Array, photo: Array, blurred: Array, weights: Array, gradient: Array, difference: Array
) -> None:
    """The gradient of a row from SSIM's blurred derivatives [3, L] and L1; |image - photo| adds to ``difference``.

    ``weights``: what L1 and SSIM of one value count.
    """
    by_mean, by_square, by_product = blurred[0], blurred[1], blurred[2]
    l1, similarity = weights[0], weights[1]
    for i in range(len(image)):
        off = image[i] - photo[i]
        sign = ONE if off > ZERO else (-ONE if off < ZERO else ZERO)
        slope = by_mean[i] + TWO * image[i] * by_square[i] + photo[i] * by_product[i]
        gradient[i] = l1 * sign + similarity * slope
        difference[i] += abs(off)


class Pictures(NamedTuple):
    """What is compared, float32 [H, L] each: ``image`` and ``photo``, and the photo's blurred mean and variance."""

    image: Array
    photo: Array
    photo_mean: Array
    photo_variance: Array


class Found(NamedTuple):
    """What comes out: ``gradient`` float32 [H, L], and ``sums`` float64 [strips, 2] of |image - photo| and of SSIM."""

    gradient: Array
    sums: Array


class Room(NamedTuple):
    """A worker's room: ``padded`` [3, L + 2 MARGIN]; ``rows`` [6, L] (three blurred rows, the column sums of |image -
    photo| and of SSIM, a row of SSIM); and the rings ``moments`` and ``derivatives`` [3, WINDOW, L]."""

    padded: Array
    rows: Array
    moments: Array
    derivatives: Array


@contracted_parallel_kernel
def compare_strips(worker: int, workers: int, pictures: Pictures, weights: Array, found: Found, scratch: Array) -> None:
    """Every ``workers``-th strip. ``weights`` float32 [2] as ``gradient_row`` has them."""
    length, sums = pictures.image.shape[1], found.sums
    own = scratch[worker]
    wide, ring_size = length + 2 * MARGIN, 3 * WINDOW * length
    padded = own[: 3 * wide].reshape(3, wide)
    padded[:] = ZERO
    rows = own[3 * wide : 3 * wide + 6 * length].reshape(6, length)
    rest = own[3 * wide + 6 * length :]
    moments = rest[:ring_size].reshape(3, WINDOW, length)
    derivatives = rest[ring_size : 2 * ring_size].reshape(3, WINDOW, length)
    room = Room(padded, rows, moments, derivatives)
    for strip in range(worker, len(sums), workers):
        rows[3:5] = ZERO
        compare_strip(strip, pictures, weights, found.gradient, room)
        for kind in range(2):
            total = 0.0
            for i in range(length):
                total += rows[3 + kind, i]
            sums[strip, kind] = total


@contracted
def compare_strip(strip: int, pictures: Pictures, weights: Array, gradient: Array, room: Room) -> None:
    """One strip of rows."""
    image, photo = pictures.image, pictures.photo
    padded, rows, moments, derivatives = room.padded, room.rows, room.moments, room.derivatives
    height = len(image)
    blurred, difference, similarity, ssim = rows[:3], rows[3], rows[4], rows[5]
    first, last = strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, height)
    for row in range(first - 2 * REACH, last + 2 * REACH):
        if 0 <= row < height:
            moments_along(image[row], photo[row], padded, moments, row % WINDOW)
        else:
            moments[:, row % WINDOW] = ZERO
        middle = row - REACH
        if middle < first - REACH:
            continue
        if 0 <= middle < height:
            for moment in range(3):
                blur_across(moments[moment], middle, blurred[moment])
            similarity_row(blurred, pictures.photo_mean[middle], pictures.photo_variance[middle], ssim, padded)
            for moment in range(3):
                blur_along(padded[moment], derivatives[moment, middle % WINDOW])
            if first <= middle < last:
                for i in range(len(ssim)):
                    similarity[i] += ssim[i]
        else:
            derivatives[:, middle % WINDOW] = ZERO
        done = middle - REACH
        if done >= first:
            for moment in range(3):
                blur_across(derivatives[moment], done, blurred[moment])
            gradient_row(image[done], photo[done], blurred, weights, gradient[done], difference)
