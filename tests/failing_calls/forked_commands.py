"""Commands of the engine, each in a fork of a process that has all loaded. Run as a script:

forked_commands.py SCENE LIFT
    Lifts SCENE, then forks for each line of standard input: a JSON object with the ``arguments`` of a command and the
    file ``said`` for all that it prints. Its exit code is a line of standard output.
"""

from __future__ import annotations

import faulthandler
import importlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.killed_engine import LONGEST_S, serve  # noqa: E402

LOADED = ("engine.export.run", "engine.export.mesh", "engine.corrections", "engine.lift.bake_more", "open3d")


def run_forked(asked: Mapping[str, Any]) -> None:
    """Does not return."""
    from engine.command_line.main import main as engine

    code = 99
    output = os.open(asked["said"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    try:
        code = int(engine(asked["arguments"]))
    except SystemExit as error:
        code = int(error.code or 0)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    for name in LOADED:
        importlib.import_module(name)
    serve(Path(sys.argv[1]), Path(sys.argv[2]), run_forked)
