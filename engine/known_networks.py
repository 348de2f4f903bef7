"""The networks that PLGS offers by name: what each is good for, its size, and its licence as its authors state it.

Standard library only: Blender lists them before an engine runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class KnownNetwork:
    """A network on huggingface.co: ``name`` and the ``revision`` that is loaded, ``label`` and what it is ``good_for``,
    its weights' size in ``bytes``, the ``licence`` of the weights and where it is ``stated``, whether that allows
    commercial use, and the processor ``seconds`` of one thread for a picture."""

    name: str
    revision: str
    label: str
    good_for: str
    bytes: int
    licence: str
    stated: str
    is_commercial: bool
    seconds: float

    @property
    def terms(self) -> str:
        """The licence in one sentence."""
        forbids = "" if self.is_commercial else ", which forbids commercial use"
        return f"the weights of {self.name} have the licence {self.licence}{forbids} ({self.stated})"


MASKS = (
    KnownNetwork(
        "facebook/mask2former-swin-small-coco-panoptic", "823b60a9dddf1829580505654f6a00b306a65381",
        "Mask2Former, COCO", "people and things (COCO's 133 classes)", 276_000_000, "CC BY-NC 4.0",
        'section "License" of MODEL_ZOO.md in github.com/facebookresearch/Mask2Former', False, 9.6,
    ),
    KnownNetwork(
        "shi-labs/oneformer_ade20k_swin_tiny", "refs/pr/6", "OneFormer, ADE20K", "rooms (ADE20K's 150 classes)",
        203_000_000, "MIT", "its card on huggingface.co", True, 5.6,
    ),
    KnownNetwork(
        "Roboflow/rf-detr-seg-medium", "", "RF-DETR, COCO", "things, as detections over other masks (COCO's 80)",
        143_000_000, "Apache-2.0", "README.md of github.com/roboflow/rf-detr", True, 1.4,
    ),
)  # fmt: skip
"""Networks that make masks; the first is the default."""
DEPTH = (
    KnownNetwork(
        "depth-anything/Depth-Anything-V2-Small-hf", "5426e4f0f36572d16453bbda7a8389317b1bef99",
        "Depth Anything V2 Small", "depth", 99_200_000, "Apache-2.0",
        "its card on huggingface.co; only Small has this licence", True, 2.7,
    ),
)  # fmt: skip
"""Networks that make depth; the first is the default."""
KNOWN = {each.name: each for each in (*MASKS, *DEPTH)}
"""All of them by their names."""


def terms_of(name: str) -> str:
    """What is known about the licence of the network called ``name``, perhaps with @REVISION, or in a folder."""
    known = KNOWN.get(name.partition("@")[0])
    return known.terms if known is not None else f"the licence of {name} is not known here: its authors state it"


def listing(names: Iterable[str]) -> str:
    """What would be downloaded, a line each, with sizes and licences."""
    sizes = ((name, KNOWN.get(name.partition("@")[0])) for name in names)
    return "\n".join(
        f"{name}: {f'{known.bytes / 1e6:.0f} MB, ' if known else ''}{terms_of(name)}" for name, known in sizes
    )
