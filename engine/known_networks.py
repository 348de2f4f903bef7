"""The networks that PLGS offers by name: what each is good for, its size, and its licence as its authors state it. They
are listed in ``known_networks.json``, which Blender reads, too."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class KnownNetwork:
    """A network on huggingface.co: ``name`` and the ``revision`` that is loaded, ``label`` and what it is ``good_for``,
    the size of its weights in ``bytes``, their ``licence`` and where it is ``stated``, whether that allows commercial
    use, and the processor ``seconds`` that one thread needs for a picture."""

    name: str
    revision: str
    label: str
    good_for: str
    bytes: int
    licence: str
    stated: str
    is_commercial: bool
    seconds: float


_TABLE = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
MASKS = tuple(KnownNetwork(**each) for each in _TABLE["masks"])
"""Networks that make masks; the first is the default."""
DEPTH = tuple(KnownNetwork(**each) for each in _TABLE["depth"])
"""Networks that make depth; the first is the default."""
KNOWN = {each.name: each for each in (*MASKS, *DEPTH)}
"""All of them by their names."""


def known_network(name: str) -> KnownNetwork | None:
    """Return the network called ``name``, which may end in @REVISION; None for a folder or an unknown name."""
    return KNOWN.get(name.partition("@")[0])


def licence_of(name: str) -> dict[str, str | bool | None]:
    """Return what ``made_by.json`` says of a network's licence: "licence" is a sentence on it, and "commercial_use"
    whether it allows commercial use (None: not known)."""
    known = known_network(name)
    if known is None:
        return {"licence": f"the licence of {name} is not known here: its authors state it", "commercial_use": None}
    said = f"the weights of {name} have the licence {_terms(known)}"
    return {"licence": said, "commercial_use": known.is_commercial}


def listing(names: Iterable[str]) -> str:
    """Return a line with size and licence for each of the networks ``names``, which would be downloaded."""
    known = ((name, known_network(name)) for name in names)
    return "\n".join(
        f"{name}, of a licence that is not known here"
        if each is None
        else f"{name}: {each.bytes / 1e6:.0f} MB, {_terms(each)}"
        for name, each in known
    )


def _terms(network: KnownNetwork) -> str:
    forbids = "" if network.is_commercial else ", which forbids commercial use"
    return f"{network.licence}{forbids} ({network.stated})"
