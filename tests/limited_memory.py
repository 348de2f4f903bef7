"""Readers in a process whose memory is limited: each reads, or refuses with a line, whatever there is.

`told_by` runs a program that names its readers: they find their files in ``folder``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

_AROUND = """
import json, resource, sys
from pathlib import Path
folder = Path(sys.argv[1])
{program}
for name, read in readers.items():
    read()
told = {{}}
for name, read in readers.items():
    for megabytes in (0, 1, 4, 16, 64, 4096):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * 4096 + (megabytes << 20), -1))
        try:
            read()
            told.setdefault(name, []).append("read")
        except refusals as error:
            assert "\\n" not in str(error)
            told.setdefault(name, []).append("refused")
        except Exception as error:
            told.setdefault(name, []).append(repr(error))
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
print(json.dumps(told))
"""


def told_by(program: str, root: Path, folder: Path) -> dict[str, list[str]]:
    """What each function of the program's table ``readers`` did with no more memory, then with more and more: "read",
    "refused" (by an error of its tuple ``refusals``), or the error that it raised.
    """
    command = [sys.executable, "-c", _AROUND.format(program=program), folder]
    said = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=300)
    assert said.returncode == 0, said.stderr
    told: dict[str, list[str]] = json.loads(said.stdout.splitlines()[-1])
    return told


def check_told(told: dict[str, list[str]]) -> None:
    assert all(answers[-1] == "read" for answers in told.values()), told
    assert all(answer in ("read", "refused") for answers in told.values() for answer in answers), told
