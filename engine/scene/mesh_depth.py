"""Cast the depth of frames from a mesh of the same room, as photogrammetry and scanning apps export it.

A mesh file does not say its axes and unit. Whether it stands where the cameras are is judged by the photos: the
outlines of the mesh, seen by a camera, should lie on the photo's edges. Where they don't, something was moved or was
not reconstructed, and the frame gets no depth there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError, reading
from ..gates import open_plain, refuse_special
from ..job.progress import Progress, unwatched
from ..posed.frames import Camera, size_within
from ..posed.layout import check_memory
from .depth import DepthMap, depth_check
from .frame import Frame, Inferred, LeftOut, Size, left_out
from .frame_choice import evenly_spread
from .mask_fit import edge_ranks
from .view import watched

MESHES = frozenset({".ply", ".obj", ".glb"})
"""Suffixes of files that ``--depth`` takes for a mesh, in lower case."""
_LONGEST = 640  # pixels of the longer side of cast depth; lifts see no more
_COMPARED = 320  # and of the pictures in which outlines are compared with edges
_LOOKED_AT = 16  # frames in which they are compared
_COARSE = 40  # pixels of the longer side at which other axes and units are looked through
_JUMP = 0.04  # an outline is where depth leaves the plane of its neighbours by this fraction of it
_EDGE = 0.8  # an edge of the photo is a pixel stronger than this fraction of all pixels
_NEAR = 0.01  # an outline and an edge agree within this fraction of the picture's width
_BAND = 0.015  # without an edge, depth is dropped this far around the outline, as a fraction of the width
_SURE = 3.0  # standard errors by which outlines must lie on edges more than by chance
_CLEARLY = 0.15  # an agreement in the mean above which no other axes are tried: right meshes have 0.25 to 0.35
_LEAST_OUTLINE = 30
_LEAST_SEEN = 0.05  # the least fraction of a frame's pixels that the mesh must fill
_BEHIND = 0.5  # the fraction of the pixels from which a mesh is seen from behind
_BYTES = 5  # memory while reading, as a multiple of the file's size
_FROM_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # glTF's y is up; ours is z
_UNITS = {"": 1.0, "from millimetres": 1e-3, "from centimetres": 1e-2, "from inches": 0.0254, "from feet": 0.3048,
          "to millimetres": 1e3, "to centimetres": 1e2}  # fmt: skip
_FIX = "Export the mesh as PLY, OBJ or GLB once more."
_EXPORT = "Export mesh and cameras from one program in one coordinate system, in metres."


class Seen(NamedTuple):
    """What a camera sees of a mesh: ``depth`` float32 [H, W] in metres, 0 = none, and ``behind``: of the rays that meet
    a surface, the share that meets its back. A back has no depth, unless both sides of the mesh count."""

    depth: NDArray[np.float32]
    behind: float


@dataclass(frozen=True, eq=False)
class Mesh:
    """The surface in the file ``path``. ``to_world``, float64 [3, 3], takes its vertices to the scene's world. ``both``
    means that the backs of triangles count as well, as the file's triangles are turned inside out."""

    path: Path
    surface: Any
    to_world: NDArray[np.float64]
    both: bool = False

    def seen(self, camera: Camera, size: Size) -> Seen:
        """Cast rays from ``camera`` at the mesh, for a picture of ``size`` (width, height)."""
        lens = camera.resized(*size)
        across = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
        down = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
        ahead = np.stack([*np.meshgrid(across, down), np.ones((lens.height, lens.width))], axis=-1)
        # The rays are brought to the mesh. They are 1 long along the view's axis, so lengths along them are depth.
        back = np.linalg.inv(self.to_world)
        rays = np.empty((lens.height, lens.width, 6), np.float32)
        rays[..., :3] = back @ lens.centre
        rays[..., 3:] = ahead @ (back @ lens.camera_to_world[:3, :3]).T
        found = self.surface.cast_rays(rays)
        depth, normal = found["t_hit"].numpy(), found["primitive_normals"].numpy()
        hit = np.isfinite(depth) & (depth > 0.0)
        from_behind = hit & ((normal * rays[..., 3:]).sum(-1) > 0.0)
        kept = hit if self.both else hit & ~from_behind
        return Seen(np.where(kept, depth, np.float32(0.0)), float(from_behind.sum() / max(1, hit.sum())))

    def depth(self, frame: Frame) -> NDArray[np.float32]:
        """Return the planar depth of a frame, float32 [H, W] in metres. It is 0 where there is none, and around
        outlines of the mesh that the photo does not show."""
        size = size_within(frame.size, (_LONGEST, _LONGEST))
        depth = self.seen(frame.camera, size).depth
        return np.where(_unshown(depth, edge_ranks(frame.read_colour(size))), np.float32(0.0), depth)


def is_mesh(path: Path) -> bool:
    """Whether the path given as depth (``--depth``) is a mesh's file, not a folder of maps; the suffix decides."""
    return path.suffix.lower() in MESHES and not path.is_dir()


def read_mesh(path: Path) -> Any:
    """Read a mesh's file as Open3D's RaycastingScene. Raises PlgsError if it holds no triangles."""
    import open3d

    with reading(path, _FIX):
        refuse_special(path)
        check_memory(_BYTES * path.stat().st_size, path)
        if path.suffix.lower() == ".glb":
            _refuse_cut_off(path)
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)  # it would print what we raise
    try:
        mesh = open3d.io.read_triangle_mesh(path)
    except MemoryError as error:  # a header that claims more than there is
        raise PlgsError("broken-mesh", "the mesh claims more vertices than memory holds", path, _FIX) from error
    vertices, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int64)
    if not len(triangles) or not len(vertices):
        raise PlgsError("no-mesh", "there are no triangles in this file", path, f"{_FIX} Points alone give no depth.")
    if triangles.min() < 0 or triangles.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise PlgsError("broken-mesh", "vertices of the mesh are missing, or are not numbers", path, _FIX)
    surface = open3d.t.geometry.RaycastingScene()
    parts = (
        open3d.core.Tensor.from_numpy(np.ascontiguousarray(each)) for each in (vertices, triangles.astype(np.uint32))
    )
    surface.add_triangles(*parts)
    return surface


def _refuse_cut_off(path: Path) -> None:
    """Raise PlgsError for a GLB whose first chunk is longer than the file, as Open3D would read it forever; OSError."""
    with open_plain(path) as file:
        head = file.read(16)
    if len(head) == 16 and int.from_bytes(head[12:], "little") > path.stat().st_size - 20:
        raise PlgsError("broken-mesh", "the file is cut off", path, _FIX)


def outlines(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return where depth, float [H, W] (0 = none), jumps: bool [H, W], true on the nearer side. A slanted plane has no
    jumps, as its inverse depth is linear in the picture."""
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape, np.float64), where=depth > 0.0)
    found = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        before, after = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
        bent = inverse - (before + after) / 2.0  # > 0: nearer than its neighbours' plane
        whole = (inverse > 0.0) & (before > 0.0) & (after > 0.0)
        found |= whole & (bent > _JUMP * inverse)
    found[:2] = found[-2:] = found[:, :2] = found[:, -2:] = False  # roll goes around the sides
    return found


def _unshown(depth: NDArray[np.float32], ranks: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels near those outlines of the mesh that lie on no edge of the photo, bool [H, W]. ``depth`` [H, W]
    is the mesh's; ``ranks`` [H, W] are the strengths of the photo's edges (`edge_ranks`)."""
    import cv2

    width = max(depth.shape)
    no_edge = (np.nan_to_num(ranks, nan=1.0) < _EDGE).astype(np.uint8)
    from_edge = cv2.distanceTransform(no_edge, cv2.DIST_L2, 3)
    lonely = outlines(depth) & (from_edge > _NEAR * width)
    if not lonely.any():
        return lonely
    distance = cv2.distanceTransform((~lonely).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(distance <= _BAND * width)


class Look(NamedTuple):
    """A frame's photo and the strength of its edges (as ranks), at the size at which meshes are compared with it."""

    frame: Frame
    size: Size
    ranks: NDArray[np.float32]


def _agreement(mesh: Mesh, look: Look) -> float:
    """Return how much stronger the photo's edges are on the mesh's outlines than on the rest of the mesh, as a
    difference of mean ranks: 0 by chance, NaN if the frame shows too little of the outlines or of the mesh."""
    depth = mesh.seen(look.frame.camera, look.size).depth
    outline = outlines(depth) & np.isfinite(look.ranks)
    if (depth > 0.0).mean() < _LEAST_SEEN or outline.sum() < _LEAST_OUTLINE:
        return float("nan")
    return float(look.ranks[outline].mean() - np.nanmean(look.ranks[depth > 0.0]))


@dataclass(frozen=True, eq=False)
class Fit:
    """A mesh, tried with some ``axes`` and unit: the share of the frames' pixels that it fills (``covered``), the share
    seen from ``behind``, and by frame how its outlines agree with edges (`_agreement`), NaN if that is unknown."""

    mesh: Mesh
    axes: str
    covered: float
    behind: float
    agreements: NDArray[np.float64]

    @property
    def sureness(self) -> float:
        """The mean agreement in standard errors: how surely outlines lie on edges more than by chance; 0 if unknown."""
        return _sureness(self.agreements)

    @property
    def stands(self) -> bool:
        return self.covered >= _LEAST_SEEN and self.behind < _BEHIND and self.sureness >= _SURE


def _sureness(values: NDArray[np.float64]) -> float:
    good = values[np.isfinite(values)]
    if len(good) < 2:
        return 0.0
    return float(good.mean() / max(good.std(ddof=1) / np.sqrt(len(good)), 1e-6))


def _tried(mesh: Mesh, axes: str, looks: Sequence[Look], longest: int = _COARSE) -> Fit:
    seen = [mesh.seen(look.frame.camera, size_within(look.size, (longest, longest))) for look in looks]
    met = [each for each in seen if each.behind < 1.0 and (each.depth > 0.0).any()]
    covered = float(np.mean([(each.depth > 0.0).mean() for each in seen]))
    behind = float(np.mean([each.behind for each in met])) if met else 1.0
    agreements = np.array([_agreement(mesh, look) for look in looks]) if covered >= _LEAST_SEEN else np.zeros(0)
    return Fit(mesh, axes, covered, behind, agreements)


def with_mesh_depth(
    frames: Sequence[Frame], path: Path, turn: NDArray[np.float64], progress: Progress = unwatched
) -> tuple[tuple[Frame, ...], tuple[LeftOut, ...], tuple[Inferred, ...]]:
    """The frames with depth cast from the mesh in the file ``path``, those left out because outlines and photo
    disagree, and what was inferred. ``turn``, float64 [3, 3], takes the poses' world to the scene's. Depth is cast when
    it is read. Raises PlgsError for a bad mesh and, with a hint on how it fits, for one that stands elsewhere."""
    mesh, inferred = _standing(read_mesh(path), path, frames, turn)
    kept, off = [], []
    for frame in watched(frames, progress):
        look = _look(frame)
        if _contradicts(mesh, look):
            off.append(frame.name)
            continue
        depth = DepthMap(path, partial(mesh.depth, frame)).through(_within(frame))
        how = " ".join([*([frame.read_as] if frame.read_as else []), "mesh", str(np.round(mesh.to_world, 6).tolist())])
        kept.append(
            replace(frame, depth_path=path, read_depth=depth.through(depth_check(frame.name, path)), read_as=how)
        )
    if not any(not frame.held_out for frame in kept):
        raise _elsewhere(path, "no frame's photo shows the mesh's outlines", _EXPORT)
    return tuple(kept), left_out("the mesh's outlines in its photo", off), inferred


def _within(frame: Frame) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return a function that sets depth [H, W] of a frame to 0 at the pixels that do not count."""
    kept = frame.read_kept
    return (lambda depth: depth) if kept is None else lambda depth: depth * kept((depth.shape[1], depth.shape[0]))


def _look(frame: Frame) -> Look:
    size = size_within(frame.size, (_COMPARED, _COMPARED))
    return Look(frame, size, edge_ranks(frame.read_colour(size)))


def _contradicts(mesh: Mesh, look: Look) -> bool:
    """Whether a frame sees nothing of the mesh, or the frame's photo is smooth where the mesh has outlines."""
    if (mesh.seen(look.frame.camera, size_within(look.size, (_COARSE, _COARSE))).depth > 0.0).mean() < _LEAST_SEEN:
        return True
    return bool(_agreement(mesh, look) < 0.0)  # False for NaN: nothing contradicts it


def _standing(
    surface: Any, path: Path, frames: Sequence[Frame], turn: NDArray[np.float64]
) -> tuple[Mesh, tuple[Inferred, ...]]:
    """Return the mesh, placed in the scene's world, and what was inferred. ``turn``, float64 [3, 3], takes the poses'
    world to the scene's. Raises PlgsError if it stands elsewhere."""
    looks = [_look(frame) for frame in evenly_spread([*frames], _LOOKED_AT)]
    worlds = [(turn, "in the poses' world"), (np.eye(3), "in the world of the scene, with z up")]
    if path.suffix.lower() == ".glb":
        of_gltf = [(world @ _FROM_GLTF, f"{how}, turned from glTF's axes") for world, how in worlds]
        worlds = [of_gltf[0], worlds[0], of_gltf[1], worlds[1]]
    usual = [_tried(Mesh(path, surface, world), how, looks) for world, how in worlds]
    usual += [_inside_out(fit, looks) for fit in usual if fit.behind >= _BEHIND]
    best = max(usual, key=lambda fit: (fit.stands, fit.sureness))
    is_clear = best.stands and float(np.nanmean(best.agreements)) >= _CLEARLY
    others = () if is_clear else _others(surface, path, turn, looks)
    other = next((each for each in others if _is_better(each, best)), None)
    if best.stands and other is None:
        is_first = best is usual[0]
        said = f"the mesh is read {best.axes}"
        why = f"its outlines lie on the photos' edges then, by {best.sureness:.0f} standard errors"
        return best.mesh, () if is_first else (Inferred("axes", said, why, is_doubtful=False),)
    if other is not None:
        raise _elsewhere(path, "the mesh does not stand where the cameras are", f"It would fit {other.axes}. {_EXPORT}")
    if best.covered < _LEAST_SEEN:
        raise _elsewhere(path, "the cameras see the mesh from behind, or not at all", _EXPORT)
    what = "the mesh's outlines are not on the photos' edges"
    raise _elsewhere(path, what, f"No other axes or unit fit either. {_EXPORT}")


def _elsewhere(path: Path, what: str, fix: str) -> PlgsError:
    return PlgsError("mesh-elsewhere", what, path, fix, option="--depth")


def _inside_out(fit: Fit, looks: Sequence[Look]) -> Fit:
    """Return the same fit with the backs of surfaces counted too, as if the mesh's triangles were turned inside out."""
    tried = _tried(replace(fit.mesh, both=True), f"{fit.axes}, with its surfaces turned inside out", looks)
    return replace(tried, behind=0.0)


def _is_better(one: Fit, other: Fit) -> bool:
    """Whether the mesh stands clearly better in one place than in another, judged by the frames that see it in both."""
    if not one.stands or not other.stands:
        return one.stands
    return _sureness(one.agreements - other.agreements) >= _SURE


def _others(surface: Any, path: Path, turn: NDArray[np.float64], looks: Sequence[Look]) -> Iterable[Fit]:
    """Return fits of the mesh with other axes and units that programs may confuse, the best agreement first. Only those
    that fill the frames most are compared with the photos."""
    rough = []
    for (axes, how), (unit, scale) in product(_axes(), _UNITS.items()):
        mesh = Mesh(path, surface, scale * turn @ axes)
        said = " and ".join(each for each in (how, f"with its lengths converted {unit}" if unit else "") if each)
        if said:
            few = evenly_spread([*looks], 6)
            seen = [mesh.seen(each.frame.camera, size_within(each.size, (_COARSE, _COARSE))) for each in few]
            filled = float(np.mean([(each.depth > 0.0).mean() * (each.behind < _BEHIND) for each in seen]))
            rough.append((filled, said, mesh))
    rough.sort(key=lambda each: -each[0])
    tried = [_tried(mesh, said, looks) for filled, said, mesh in rough[:_LOOKED_AT] if filled >= _LEAST_SEEN]
    return sorted(tried, key=lambda fit: -fit.sureness)


def _axes() -> list[tuple[NDArray[np.float64], str]]:
    """Return the 24 rotations that map axes onto axes, float64 [3, 3], each with its name."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turned = np.zeros((3, 3))
        turned[range(3), order] = signs
        if np.linalg.det(turned) > 0.0:
            named = ", ".join(f"{'-' * (sign < 0)}{'xyz'[at]}" for at, sign in zip(order, signs, strict=True))
            found.append((turned, "" if named == "x, y, z" else f"with its axes {named} as x, y, z"))
    return found
