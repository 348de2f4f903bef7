"""What an engine can do, and the packages that each ability needs: one table for handshake, command line and panel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError


@dataclass(frozen=True)
class Capability:
    """One ability of the engine.

    It needs its ``packages`` besides what every engine has, each given with the module that is imported. With a
    ``size``, in bytes on the disk, `python -m engine add` can add them by ``requirements/hashes-NAME.txt``.
    """

    label: str
    packages: Mapping[str, str]
    size: int = 0
    needs_cuda: bool = False


CAPABILITIES: dict[str, Capability] = {
    "lift": Capability("Lift", {}),
    "passes": Capability("Passes", {}),
    "meshes": Capability("Make Meshes", {}),
    "points": Capability("Labelled points", {}),
    "segment": Capability("Make Masks", {"transformers": "transformers", "pillow": "PIL"}, 130_000_000),
    "record3d": Capability("Record3D's depth (.r3d)", {"pyliblzfse": "liblzfse"}, 1_000_000),
    "hypersim": Capability("Hypersim", {"h5py": "h5py"}, 16_000_000),
    "colmap": Capability("Poses of photos and films", {"pycolmap": "pycolmap"}, 134_000_000),
    "usd": Capability("OpenUSD", {"usd-core": "pxr"}, 209_000_000),
    "farm": Capability(
        "Batches on many machines", {"distributed": "distributed", "dask-jobqueue": "dask_jobqueue"}, 38_000_000
    ),
    "cuda": Capability("Lift on a GPU", {"gsplat": "gsplat"}, needs_cuda=True),
}
"""The abilities, by the names that the command line and scripts use. Sizes are those on Linux."""

ADDED = tuple(name for name, each in CAPABILITIES.items() if each.size)
"""The names of the abilities that can be added to an engine."""


def requirements_path(root: Path, name: str) -> Path:
    """The file that pins the packages of one of `ADDED`."""
    return root / "requirements" / f"{name}.txt"


def addition_hashes_path(root: Path, name: str) -> Path:
    """The file with the SHA-256 of everything that is added for one of `ADDED`, for every system and Python."""
    return root / "requirements" / f"hashes-{name}.txt"


def refuse_unknown(name: str) -> None:
    """Raise PlgsError for a name that cannot be added."""
    if name not in ADDED:
        raise PlgsError(f'nothing called "{name}" can be added to an engine', "add", f"Choose {', '.join(ADDED)}.")
