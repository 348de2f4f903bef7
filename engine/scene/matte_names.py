"""What classes and instances are called in Cryptomatte, by the engine that writes and by Blender that picks."""

from __future__ import annotations

from collections.abc import Mapping


def matte_names(names: Mapping[int, str]) -> dict[int, str]:
    """The names that mattes go by: no commas, quotes or backslashes, and each only once (else the id follows)."""
    clean = {
        key: " ".join("".join(" " if c in ",\"'\\" else c for c in name).split()) or f"id {key}"
        for key, name in names.items()
    }
    seen: dict[str, int] = {}
    for name in clean.values():
        seen[name] = seen.get(name, 0) + 1
    return {key: name if seen[name] == 1 else f"{name} #{key}" for key, name in clean.items()}
