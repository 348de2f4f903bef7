"""Which format is it? Each is recognised by the names of its files; nothing is decoded for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..frame import SceneError
from ..layout import shown
from . import (
    colmap,
    folders,
    hypersim,
    nerfstudio,
    open3d_log,
    polycam,
    record3d,
    replica,
    scannetpp,
    sens,
    seven_scenes,
    stray,
    tum,
)
from .capture import Capture


@dataclass(frozen=True)
class SceneFormat:
    """A format: the ``name`` that users give, what is looked for, whether a place has it, and its reader.

    ``read`` raises SceneError.
    """

    name: str
    looks_for: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Capture]


FORMATS: tuple[SceneFormat, ...] = (
    SceneFormat("scannet", folders.LOOKS_FOR, folders.recognises, folders.read),
    SceneFormat("nerfstudio", nerfstudio.LOOKS_FOR, nerfstudio.recognises, nerfstudio.read),
    SceneFormat("colmap", colmap.LOOKS_FOR, colmap.recognises, colmap.read),
    SceneFormat("tum", tum.LOOKS_FOR, tum.recognises, tum.read),
    SceneFormat("icl", tum.LOOKS_FOR_ICL, tum.recognises_icl, tum.read_icl),
    SceneFormat("7scenes", seven_scenes.LOOKS_FOR, seven_scenes.recognises, seven_scenes.read),
    SceneFormat("tsdf-fusion", seven_scenes.LOOKS_FOR_TSDF, seven_scenes.recognises_tsdf, seven_scenes.read_tsdf),
    SceneFormat("replica", replica.LOOKS_FOR, replica.recognises, replica.read),
    SceneFormat("vmap", replica.LOOKS_FOR_VMAP, replica.recognises_vmap, replica.read_vmap),
    SceneFormat("sens", sens.LOOKS_FOR, sens.recognises, sens.read),
    SceneFormat("polycam", polycam.LOOKS_FOR, polycam.recognises, polycam.read),
    SceneFormat("record3d", record3d.LOOKS_FOR, record3d.recognises, record3d.read),
    SceneFormat("stray", stray.LOOKS_FOR, stray.recognises, stray.read),
    SceneFormat("scannetpp", scannetpp.LOOKS_FOR, scannetpp.recognises, scannetpp.read),
    SceneFormat("hypersim", hypersim.LOOKS_FOR, hypersim.recognises, hypersim.read),
    SceneFormat("open3d", open3d_log.LOOKS_FOR, open3d_log.recognises, open3d_log.read),
)


def find_format(place: Path, name: str | None = None) -> SceneFormat:
    """The format called ``name``, or the one that ``place``, a folder or file, has by its looks.

    The first format comes before all others: prepared folders often hold what they were made from as well. Raises
    SceneError for an unknown name, and when no other format or more than one is recognised.
    """
    if not place.exists():
        raise SceneError("there is no such folder", place, "Name the folder of a scene.")
    known = {each.name: each for each in FORMATS}
    if name is not None:
        if name not in known:
            raise SceneError(f'no format is called "{shown(name)}"', place, f"Choose one of {', '.join(known)}.")
        return known[name]
    try:
        found = [each for each in FORMATS if each.recognises(place)]
    except OSError as error:
        raise SceneError(f"the folder cannot be read ({error.strerror})", place, "Check its permissions.") from error
    if len(found) > 1 and found[0] is not FORMATS[0]:
        names = " and ".join(each.name for each in found)
        raise SceneError(f"this looks like {names}", place, f"Say which one it is, such as --format {found[0].name}.")
    if not found:
        wanted = "; ".join(f"{each.name}: {each.looks_for}" for each in FORMATS)
        raise SceneError("no scene of a known format is here", place, f"Looked for {wanted}.")
    return found[0]
