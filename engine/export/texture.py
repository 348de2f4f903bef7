"""Make textures for a surface, cut out of the photos: each triangle shows the pixels of the photo that sees it best. A
simplified "Let There Be Color!" (Waechter, Moehrle, Goesele, ECCV 2014): each triangle chooses a view, and neighbours
prefer the same one; connected triangles of one view form a chart, a rectangle of its photo; seams between charts are
levelled by least squares, here with a linear offset for each chart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..job.progress import Progress, part_of, unwatched
from ..posed.ply import labels_of_triangles
from ..scene import Frame, photo_detail, read_ahead, watched
from ..scene.exposure import BRIGHT, exposure_beside
from ..scene.pixels import image_bytes
from ..scene.view import border_mask
from .fusion import Ints, SmallView, Surface
from .mending import around_vertices, numbered, pieces

LARGEST = 8192  # the square of this limits the pixels of all pictures together; photos are at most this wide
_FILLED = 0.6  # approximate share of a picture that its charts fill
# A view sees a vertex if its depth there differs by at most this many metres, or this fraction.
_NEAR, _NEAR_SHARE = 0.05, 0.02
_STEP, _BESIDE_STEP = 1.1, 0.02  # a ratio of depths at which one surface hides another; the weight of views there
_ROUNDS = 12  # rounds of smoothing of the views' qualities, so that neighbours choose the same view
_OVEREXPOSED = 0.3  # the weight of an overexposed pixel
_ODD = 30.0  # difference of values above which a photo shows something other than the vertex
_COARSE, _SPREAD = 4, 0.025  # a cell's side in pixels; over what share of a photo's width colours are matched
_MARGIN = 3  # pixels around a chart that are copied with it
_CELL = 4  # the side in pixels of the square that a triangle without a view has in the picture


@dataclass(frozen=True, eq=False)
class Texture:
    """A surface's texture. ``uv`` float32 [T, 3, 2] is where each triangle corner lies in its label's picture, as
    fractions from the upper left; ``pictures`` uint8 [H, W, 3] are by label."""

    uv: NDArray[np.float32]
    pictures: dict[int, NDArray[np.uint8]]


def jpeg_bytes(picture: NDArray[np.uint8]) -> bytes:
    """Encode an RGB picture, uint8 [H, W, 3], as JPEG without chroma subsampling. Raises PlgsError if that fails."""
    ways = [cv2.IMWRITE_JPEG_QUALITY, 93, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return image_bytes(picture, ".jpg", ways=ways)


def textured(surface: Surface, label: Ints, views: Sequence[SmallView], progress: Progress = unwatched) -> Texture:
    """The texture of a surface with labelled vertices [V] from the photos of the ``views``. Triangles that no photo
    shows have their vertices' colours. Raises PlgsError if a photo cannot be read."""
    frames = [view.frame for view in views if view.frame is not None]
    rating, choosing, cutting, packing = (part_of(progress, part / 4, (part + 1) / 4, 100) for part in range(4))
    quality, gains = _qualities(surface, views, frames, rating)
    labels = labels_of_triangles(surface.triangles, label)
    chosen = _chosen(surface.triangles, len(surface.xyz), quality, choosing)
    of_triangle, view, of_label = _charts(surface.triangles, labels, chosen)
    wedge, vertex, chart = _wedges(surface.triangles, of_triangle)
    pixel = np.empty((len(vertex), 2))
    for number, frame in enumerate(frames):
        own = view[chart] == number
        pixel[own] = frame.camera.project(surface.xyz[vertex[own]])[0]
    boxes = _boxes(pixel, chart, np.array([frame.size for frame in frames])[view])
    sides, bare = boxes[:, 2:] - boxes[:, :2], of_triangle < 0
    area = (sides.prod(axis=1).sum() + _CELL**2 * bare.sum()) / _FILLED
    scale = min(1.0, LARGEST / np.sqrt(max(area, 1.0)), LARGEST / max(sides.max(initial=1), 1))
    sizes = np.maximum(np.rint(scale * sides), 1).astype(np.int64)
    crops: list[NDArray[np.uint8]] = [np.empty(0, np.uint8)] * len(boxes)
    for number, photo in enumerate(read_ahead(frames, _photo)):
        own = view[chart] == number
        table = np.rint(np.clip(np.arange(256)[:, None] / gains[number], 0, 255)).astype(np.uint8)
        photo = np.stack([table[photo[..., each], each] for each in range(3)], axis=-1)
        even = _evened(photo, pixel[own], surface.rgb[vertex[own]])
        for each in np.flatnonzero(view == number).tolist():
            left, top, right, bottom = boxes[each].tolist()
            crops[each] = cv2.resize(even[top:bottom, left:right], sizes[each].tolist(), interpolation=cv2.INTER_AREA)
        cutting(number + 1, len(frames))
    uv, pictures = np.zeros((len(labels), 3, 2), np.float32), {}
    for value in watched(np.unique(labels).tolist(), packing):
        own, cells = np.flatnonzero(of_label == value), np.flatnonzero(bare & (labels == value))
        picture, corner = _packed([crops[each] for each in own], len(cells))
        for each in own.tolist():
            crops[each] = np.empty(0, np.uint8)  # frees its memory
        origin = np.zeros((len(boxes), 2))
        origin[own] = corner[: len(own)]
        rows = np.flatnonzero(~bare & (labels == value))
        at, number = wedge[rows], chart[wedge[rows]]
        inside = (pixel[at] - boxes[number, :2]) / sides[number] * sizes[number]
        uv[rows] = (origin[number] + inside) / picture.shape[1::-1]
        uv[cells] = _fill_cells(picture, corner[len(own) :], surface.rgb[surface.triangles[cells]])
        pictures[value] = picture
    return Texture(uv, pictures)


class _Quality(NamedTuple):
    """How well a view shows vertices: the ``vertices`` int32 [n] that it sees, and the ``pixels`` float32 [n] that its
    photo has per square metre of surface there, above 0, reduced for blur and overexposure."""

    vertices: NDArray[np.int32]
    pixels: NDArray[np.float32]


def _qualities(
    surface: Surface, views: Sequence[SmallView], frames: Sequence[Frame], progress: Progress
) -> tuple[list[_Quality], NDArray[np.float64]]:
    """Return how well each view shows vertices, and how much brighter each photo is than the vertices, [N, 3]."""
    found, gains = [], np.ones((len(views), 3))
    detail = np.zeros(len(views))
    for number, (view, photo) in enumerate(zip(views, read_ahead(frames, _photo), strict=True)):
        camera, large = view.camera, frames[number].camera
        seen, pixel, depth = camera.seen(surface.xyz)
        column, row = pixel.astype(np.int64).T
        near = cv2.erode(view.depth, np.ones((3, 3), np.uint8))[row, column]
        away = camera.centre - surface.xyz[seen]
        cosine = (away * surface.normal[seen]).sum(axis=1) / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        shown = np.abs(view.depth[row, column] - depth) < np.maximum(_NEAR, _NEAR_SHARE * depth)
        worth = large.fx * large.fy * np.maximum(cosine, 0.0) / np.maximum(depth, 1e-3) ** 2
        worth *= np.where(near * _STEP < depth, _BESIDE_STEP, 1.0) * shown
        x, y = (pixel * np.divide(photo.shape[1::-1], camera.size)).astype(np.int64).T
        colour = photo[y, x]
        worth *= np.where((colour > BRIGHT).any(axis=1), _OVEREXPOSED, 1.0) * colour.any(axis=1)  # black is a border
        detail[number] = photo_detail(photo)
        own = surface.rgb[seen]
        gains[number] = exposure_beside(colour[worth > 0], own[worth > 0])
        odd = np.abs(cv2.blur(photo, (3, 3))[y, x] / gains[number] - own).max(axis=1)
        worth *= np.maximum(np.exp(-((odd / _ODD) ** 2)), 1e-3)
        shows = worth > 0
        found.append(_Quality(seen[shows].astype(np.int32), worth[shows].astype(np.float32)))
        progress(number + 1, len(views))
    sharp = (np.minimum(detail / max(float(np.median(detail)), 1e-9), 1.0) ** 2).astype(np.float32)
    return [_Quality(one.vertices, one.pixels * factor) for one, factor in zip(found, sharp, strict=True)], gains


def _photo(frame: Frame) -> NDArray[np.uint8]:
    """Read the photo, uint8 [H, W, 3], with black borders made entirely black."""
    photo = frame.read_colour(None)
    border = border_mask(photo)
    return np.where(border[..., None], np.uint8(0), photo) if border.any() else photo


def _chosen(triangles: Ints, count: int, qualities: Sequence[_Quality], progress: Progress) -> Ints:
    """The chosen view of each triangle, [T], -1 where none shows all its corners; there are ``count`` vertices. A
    view's share of the best quality is smoothed over the vertices that it shows, so that neighbours choose the same."""
    best = np.full(count, 1e-9, np.float32)
    for vertices, pixels in qualities:
        best[vertices] = np.maximum(best[vertices], pixels)
    around = around_vertices(triangles, count).astype(np.float32)
    view, score = np.full(len(triangles), -1, np.int64), np.zeros(len(triangles), np.float32)
    for number, (vertices, pixels) in enumerate(watched(qualities, progress)):
        share, beside = np.sqrt(pixels / best[vertices]), around[vertices][:, vertices]
        for _ in range(_ROUNDS):
            share = 0.5 * (share + beside @ share)
        everywhere = np.zeros(count, np.float32)
        everywhere[vertices] = share
        corners = everywhere[triangles]
        own = corners.sum(axis=1) * (corners > 0).all(axis=1)
        view[own > score], score = number, np.maximum(own, score)
    return view


def _charts(triangles: Ints, labels: Ints, view: Ints) -> tuple[Ints, Ints, Ints]:
    """Group triangles into charts by their labels and views [T]. Returns each triangle's chart [T], -1 for none, and
    each chart's view and label [C]."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    key = edges[:, 0] << 32 | edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    first, second = order[same] // 3, order[same + 1] // 3  # triangles with a common edge
    joined = (labels[first] == labels[second]) & (view[first] == view[second])
    number = pieces(np.stack([first, second], axis=1)[joined], len(view))
    shown = view >= 0
    _, where, of_triangle = np.unique(number[shown], return_index=True, return_inverse=True)
    whole = np.full(len(view), -1, np.int64)
    whole[shown] = of_triangle
    return whole, view[shown][where], labels[shown][where]


def _wedges(triangles: Ints, chart: Ints) -> tuple[Ints, Ints, Ints]:
    """Number the wedges, which are pairs of a vertex and a chart that it is in. Returns each corner's wedge [T, 3], -1
    without a chart, and each wedge's vertex and chart [W]."""
    shown = chart >= 0
    wedge = np.full(triangles.shape, -1, np.int64)
    corner, own = triangles[shown].ravel(), np.repeat(chart[shown], 3)
    number, vertex = numbered(corner, own, int(triangles.max(initial=-1)) + 1)
    wedge[shown] = number.reshape(-1, 3)
    of_wedge = np.empty_like(vertex)
    of_wedge[number] = own
    return wedge, vertex, of_wedge


def _boxes(pixel: NDArray[np.float64], chart: Ints, size: Ints) -> Ints:
    """The rectangle of each chart in its photo of this ``size`` [C, 2]: left, top, right, bottom, int64 [C, 4]."""
    low, high = np.full(size.shape, np.inf), np.full(size.shape, -np.inf)
    np.minimum.at(low, chart, pixel)
    np.maximum.at(high, chart, pixel)
    ends = np.floor(low) - _MARGIN, np.ceil(high) + _MARGIN
    return np.concatenate([np.maximum(ends[0], 0), np.minimum(ends[1], size)], axis=1).astype(np.int64)


def _evened(photo: NDArray[np.uint8], pixel: NDArray[np.float64], rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a photo with its colours near ``pixel`` [N, 2] shifted to ``rgb`` [N, 3] on average; its details stay."""
    height, width = photo.shape[:2]
    size = -(-width // _COARSE), -(-height // _COARSE)
    column, row = pixel.astype(np.int64).clip(0, (width - 1, height - 1)).T
    away = np.clip(rgb - photo[row, column].astype(np.float64), -_ODD, _ODD)
    cell = row // _COARSE * size[0] + column // _COARSE
    sums = [np.bincount(cell, each, size[0] * size[1]) for each in (*away.T, np.ones(len(cell)))]
    spread = cv2.GaussianBlur(
        np.stack(sums, axis=-1).reshape(*size[::-1], 4).astype(np.float32), (0, 0), _SPREAD * width / _COARSE
    )
    offset = spread[..., :3] / np.maximum(spread[..., 3:], 1e-3)
    whole = cv2.resize(offset, (size[0] * _COARSE, size[1] * _COARSE), interpolation=cv2.INTER_LINEAR)
    return np.rint(np.clip(photo + whole[:height, :width], 0, 255)).astype(np.uint8)


def _packed(crops: Sequence[NDArray[np.uint8]], cells: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Pack all crops into one picture, in rows of descending height, and ``cells`` squares of _CELL pixels below.
    Returns the picture, and the upper left corners of crops and squares, float64 [crops + cells, 2]."""
    area = sum(crop.shape[0] * crop.shape[1] for crop in crops) + cells * _CELL**2
    width = max(*(crop.shape[1] for crop in crops), round(np.sqrt(1.1 * area)), _CELL, 0)  # 1.1: shelves leave gaps
    corner, x, y, height = np.zeros((len(crops) + cells, 2)), 0, 0, 0
    for each in sorted(range(len(crops)), key=lambda each: (-crops[each].shape[0], each)):
        if x + crops[each].shape[1] > width:
            x, y, height = 0, y + height, 0
        corner[each] = x, y
        x, height = x + crops[each].shape[1], max(height, crops[each].shape[0])
    across = width // _CELL
    down, along = np.divmod(np.arange(cells), across)
    corner[len(crops) :] = np.stack([_CELL * along, y + height + _CELL * down], axis=1)
    picture = np.zeros((max(y + height + _CELL * -(-cells // across), 1), width, 3), np.uint8)
    for crop, (left, top) in zip(crops, corner[: len(crops)].astype(np.int64).tolist(), strict=True):
        picture[top : top + crop.shape[0], left : left + crop.shape[1]] = crop
    return picture, corner


def _fill_cells(picture: NDArray[np.uint8], corner: NDArray[np.float64], rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Draw triangles with corner colours [N, 3, 3] into the cells at ``corner`` [N, 2]; return their uv [N, 3, 2]."""
    offsets = np.array([[0.5, 0.5], [_CELL - 0.5, 0.5], [0.5, _CELL - 0.5]])
    y, x = np.indices((_CELL, _CELL)) / (_CELL - 1)
    mixed = np.einsum("nkc,kyx->nyxc", rgb.astype(np.float32), np.stack([1 - x - y, x, y]))
    left, top = corner.astype(np.int64).T
    rows, columns = np.indices((_CELL, _CELL))
    picture[top[:, None, None] + rows, left[:, None, None] + columns] = np.rint(mixed.clip(0, 255))
    return ((corner[:, None] + offsets) / picture.shape[1::-1]).astype(np.float32)
