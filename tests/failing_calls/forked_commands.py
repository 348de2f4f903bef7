"""Commands of the engine, each in a fork of a process that has all loaded. Run as a script:

forked_commands.py SCENE LIFT
    Lifts SCENE, then forks for each line of standard input: a JSON object with the ``arguments`` of a command and the
    file ``said`` for all that it prints. Its exit code is a line of standard output.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

LOADED = ("engine.export.run", "engine.export.mesh", "engine.corrections", "engine.lift.bake_more", "open3d")
LONGEST_S = 300.0
"""A command that takes longer hangs: it ends, and tells where."""


def serve(scene: Path, lift: Path) -> None:
    import OpenEXR

    from engine.command_line.run_engine import run_engine
    from engine.job import LiftFolder, LiftRequest
    from engine.lift import bake_more, run

    run.CHECKPOINT_EVERY_S = bake_more.KEEP_EVERY_S = -1.0  # each step is a checkpoint: there are more files to fail
    for name in LOADED:
        importlib.import_module(name)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    request = LiftRequest(scene=scene, options={"steps": 2, "warm_start": False})
    answers.write(f"{int(run_engine(LiftFolder.create(lift, request)))}\n")
    OpenEXR.set_global_thread_count(0)  # its threads do not follow into a fork, which would wait for them
    gc.freeze()  # a fork does not copy what its collector would touch
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            run_forked(**json.loads(line))
        answers.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")


def run_forked(arguments: list[str], said: str) -> None:
    """Does not return."""
    from engine.command_line.main import main as engine

    code = 99
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    try:
        code = int(engine(arguments))
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
    serve(Path(sys.argv[1]), Path(sys.argv[2]))
