"""Programs that answer as a Python with this engine does."""

import json
from pathlib import Path

from plgs.engine.job.handshake import CAPABILITIES, VERSION, EngineAnswer
from plgs.engine.json_file import to_line

WANTED = {"torch": "2.0", "numba": "1.0"}


def pretended_python(
    path: Path, instead: str = "", *, version: str = VERSION, lacks: str = "", **packages: str | None
) -> Path:
    """Write a program that answers a handshake, ``lacks`` a capability's package, or runs a shell line ``instead``."""
    capabilities = {name: ("a-package",) if name == lacks else () for name in CAPABILITIES}
    answer = EngineAnswer(version, "3.11.9", path, {**WANTED, **packages}, WANTED, 4, None, capabilities)
    events = [
        {"event": "answer", "answer": json.loads(to_line(answer.to_json()))},
        {"event": "done", "state": "finished"},
    ]
    lines = "\n".join(json.dumps({"seq": seq, "time": 0.0, **event}) for seq, event in enumerate(events, start=1))
    answering = f"""
while [ $# -gt 1 ]; do [ "$1" = --events ] && events="$2"; shift; done
cat >> "$events" <<'END'
{lines}
END"""
    path.write_text(f"#!/bin/sh\n{instead or answering}\n")
    path.chmod(0o755)
    return path
