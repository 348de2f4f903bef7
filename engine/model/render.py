"""Renders a lifted scene from a camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..raster.conventions import BLUR, NEAR
from ..scene import Camera
from .detail import blurred_scales
from .gaussians import decode, no_labels
from .neural_gaussians import ClipRange, NeuralGaussians, PanopticRendering
from .scene_labels import ShownLabels, shown_labels, shown_probabilities
from .structured import LabelChannels, SceneFill, StructuredScene

MOST_BYTES = 1 << 27
"""The most bytes of a band's label coverage. Larger bands are not faster; smaller ones are slower."""
KEPT = 16
"""Classes and instances of a pixel that are copied back from a device. A pixel seldom shows more than five."""
TILE_ROWS = 16
"""Bands begin at a row of the rasteriser's tiles."""
REACH = 3.5
"""Standard deviations within which a Gaussian's alpha can reach 1/255, rounded up a little."""


@torch.no_grad()
def render_view(scene: StructuredScene, camera: Camera, labels: ShownLabels | None = None) -> PanopticRendering:
    """Render colour, depth and label coverage of a view, at the camera's size. ``labels``: the scene's labels, decoded
    before by `shown_labels` for many views."""
    (rendering,) = render_bands(scene, camera, labels, most_bytes=None)
    return rendering


@torch.no_grad()
def render_bands(
    scene: StructuredScene,
    camera: Camera,
    labels: ShownLabels | None = None,
    *,
    clip: ClipRange | None = None,
    most_bytes: int | None = MOST_BYTES,
    want_surface: bool = True,
) -> Iterator[PanopticRendering]:
    """Render a view in bands of rows, from the top, so that memory does not grow with labels times pixels.
    ``most_bytes`` limits the label coverage of a band; None: one band. ``labels``: decoded before, for many views.
    Without ``want_surface``, depth is 0. ``clip``: only Gaussians in this range of depth."""
    if labels is None and scene.voted is not None:
        labels = shown_labels(scene)
    known = None if labels is None else no_labels(scene.anchors)
    drawn = decode(scene.anchors, scene.decoders, camera, known_labels=known)
    k = scene.anchors.gaussians_per_anchor
    rows = drawn.rows(k)
    finest = None if scene.finest is None else scene.finest[rows // k]
    guessed = None
    if scene.fill is not None:
        drawn, rows, finest, guessed = _filled(scene.fill, camera, drawn, rows, finest)
    seen = _see(drawn, rows, finest, camera, clip or ClipRange())
    bands = row_bands(camera, len(scene.channels.class_ids) + len(scene.channels.slot_ids), most_bytes)
    for each in bands:
        reaching = seen if len(bands) == 1 else seen.reaching(each)
        yield _draw_rows(
            reaching, labels, scene.channels, camera, rows=each, want_surface=want_surface, guessed=guessed
        )


def _filled(
    fill: SceneFill, camera: Camera, drawn: NeuralGaussians, rows: torch.Tensor, finest: torch.Tensor | None
) -> tuple[NeuralGaussians, torch.Tensor, torch.Tensor | None, torch.Tensor]:
    """Leave out the decoded Gaussians of removed objects, and append the fill. Return the Gaussians, their rows in the
    scene's labels, the side of the finest pixel at each (see `detail`), and which are guessed, float32 [N, 1]."""
    kept, new = ~fill.gone[rows], len(fill.means)
    fill = replace(fill, opacities=_opacities_seen(fill, camera))
    names = ("means", "scales", "quats", "opacities", "colours")
    both = {name: torch.cat([getattr(drawn, name)[kept], getattr(fill, name)]) for name in names}
    labels = torch.cat([drawn.labels[kept], drawn.labels.new_zeros(new, drawn.labels.shape[1])])
    own = torch.arange(new, device=rows.device) + len(fill.gone)
    guessed = torch.cat([fill.guessed.new_zeros(int(kept.sum())), fill.guessed])[:, None]
    finest = None if finest is None else torch.cat([finest[kept], finest.new_zeros(new)])
    return replace(drawn, **both, labels=labels), torch.cat([rows[kept], own]), finest, guessed


def _opacities_seen(fill: SceneFill, camera: Camera) -> torch.Tensor:
    """Return the opacities [P] of a fill's disks for a camera: lower where a disk is thinner than the pixel that BLUR
    widens it to (as in Mip-Splatting, Yu et al. 2024). Otherwise slanted floors would appear a pixel too near."""
    axis, centre = (torch.from_numpy(each).to(fill.means) for each in (camera.world_to_camera[2, :3], camera.centre))
    ways = axis.expand_as(fill.means) if camera.projection == "orthographic" else fill.means - centre
    w, x, y, z = fill.quats.unbind(1)
    normal = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)
    wide = fill.scales[:, 0] * camera.fx / (ways @ axis).clamp_min(NEAR)
    thin = wide * (ways * normal).sum(dim=1).abs() / ways.norm(dim=1)
    return fill.opacities * (wide * thin) / ((wide * wide + BLUR) * (thin * thin + BLUR)).sqrt()


def row_bands(camera: Camera, channels: int, most_bytes: int | None) -> list[tuple[int, int]]:
    """Divide a picture into bands of rows; return the first row and the last row + 1 of each. All have the same height,
    except that the last may have fewer rows."""
    fitting = camera.height if most_bytes is None else most_bytes // (4 * max(channels, 1) * camera.width)
    count = -(-camera.height // max(fitting, TILE_ROWS))
    height = -(-camera.height // (count * TILE_ROWS)) * TILE_ROWS
    return [(first, min(first + height, camera.height)) for first in range(0, camera.height, height)]


@dataclass(frozen=True, eq=False)
class _Seen:
    """The Gaussians that a camera sees: ``drawn``, decoded; ``rows_of`` int64 [N], their rows in the scene's labels;
    ``chosen`` int64 [n], to draw; ``row``, ``reach`` float32 [N], centre and radius in picture rows; ``near``,
    metres."""

    drawn: NeuralGaussians
    rows_of: torch.Tensor
    chosen: torch.Tensor
    row: torch.Tensor
    reach: torch.Tensor
    near: float

    def reaching(self, rows: tuple[int, int]) -> _Seen:
        """Choose the Gaussians that may cover a pixel of ``rows`` (first, last + 1); a few others are harmless."""
        first, end = rows
        touches = (self.row + self.reach >= first) & (self.row - self.reach <= end)
        return replace(self, chosen=self.chosen[touches[self.chosen]])

    def of(self, values: torch.Tensor) -> torch.Tensor:
        """Return the rows of ``values`` [N, ...], one for each Gaussian seen, for the chosen Gaussians."""
        return values if len(self.chosen) == len(values) else values.index_select(0, self.chosen)


def _see(
    drawn: NeuralGaussians, rows_of: torch.Tensor, finest: torch.Tensor | None, camera: Camera, clip: ClipRange
) -> _Seen:
    to_camera, near = torch.from_numpy(camera.world_to_camera).to(drawn.means), max(clip.near, NEAR)
    _, down, depth = (drawn.means @ to_camera[:3, :3].T + to_camera[:3, 3]).unbind(1)
    clipped = depth
    if clip.along_rays:
        clipped, near = (drawn.means - torch.from_numpy(camera.centre).to(drawn.means)).norm(dim=1), NEAR
    chosen = ((depth > near) & (clipped > clip.near) & (clipped < clip.far)).nonzero().squeeze(1)
    depth = torch.ones_like(depth) if camera.projection == "orthographic" else depth.clamp_min(near)
    if finest is not None:
        drawn = replace(drawn, scales=blurred_scales(drawn.scales, finest, depth, camera))
    slope = down / depth
    # the largest standard deviation, seen at the slant of the ray, bounds the footprint's deviation in rows
    deviation = drawn.scales.amax(dim=1) * camera.fy / depth * (1 + slope * slope).sqrt()
    reach = REACH * (deviation * deviation + BLUR).sqrt() + 1.0
    return _Seen(drawn, rows_of, chosen, slope * camera.fy + camera.cy, reach, near)


def _draw_rows(
    seen: _Seen,
    labels: ShownLabels | None,
    channels: LabelChannels,
    camera: Camera,
    *,
    rows: tuple[int, int],
    want_surface: bool,
    guessed: torch.Tensor | None = None,
) -> PanopticRendering:
    names = ("means", "scales", "quats", "opacities", "colours", "labels")
    drawn = replace(seen.drawn, **{name: seen.of(getattr(seen.drawn, name)) for name in names})
    own = drawn.labels if labels is None else labels.of(seen.of(seen.rows_of))
    if guessed is not None:
        own = torch.cat([own, seen.of(guessed)], dim=1)
    rendering = drawn.drawn_by(camera, own, near=seen.near, rows=rows, want_surface=want_surface)
    alpha = rendering.alpha.numpy(force=True)
    assert rendering.labels is not None  # as requested
    classes, shown = len(channels.class_ids), rendering.labels
    share = None
    if guessed is not None:
        share, shown = shown[..., -1].numpy(force=True) + 1 - alpha, shown[..., :-1]
    if labels is None:
        shown = shown_probabilities(shown[..., :classes], shown[..., classes:], channels)
    coverage = shown.numpy() if shown.device.type == "cpu" else likeliest(shown)
    return PanopticRendering(
        camera=camera.of_rows(*rows),
        image=rendering.image.clamp_(0.0, 1.0).numpy(force=True),
        alpha=alpha,
        depth=np.zeros_like(alpha) if rendering.surface is None else rendering.surface.numpy(force=True),
        class_coverage=coverage[..., :classes],
        instance_coverage=coverage[..., classes:],
        class_ids=channels.class_ids,
        instance_ids=channels.shown_ids,
        guessed=share,
    )


def likeliest(
    coverage: torch.Tensor,  # [H, W, L]
) -> NDArray[np.float32]:
    """Copy the KEPT largest values of each pixel from the device, as an array [H, W, L] that is 0 elsewhere. To copy
    all would take longer than rendering."""
    share, label = (each.numpy(force=True) for each in coverage.topk(min(KEPT, coverage.shape[-1]), dim=-1))
    kept = np.zeros(coverage.shape, np.float32)
    np.put_along_axis(kept, label, share, axis=-1)
    return kept
