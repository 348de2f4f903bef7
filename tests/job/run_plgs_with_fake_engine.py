"""run_plgs.py with another engine and, unless told otherwise, without Blender: for tests of what surrounds both.

run_plgs_with_fake_engine.py BEHAVIOUR ARGS...: for the behaviours see fake_engine.py.
"""

import argparse
import importlib
import signal
import sys
import time
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))


def main(behaviour: str, arguments: list[str]) -> int:
    """What run_plgs.main returns."""
    import run_plgs

    # A shell that runs tests in the background makes them ignore Ctrl-C, and nohup a closed terminal.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    run_plgs.load_package()
    session = importlib.import_module("plgs.engine.job.terminal")

    def fake_command(python: Path, lift: Path, *, resume: bool, program: str) -> list[str | Path]:
        fake = Path(__file__).with_name("fake_engine.py")
        return [sys.executable, fake, behaviour, lift, *(["--resume"] if resume else [])]

    resumable = session.resumable

    def announced_resumable(options: argparse.Namespace) -> object:
        print("looks for a lift to resume", file=sys.stderr, flush=True)
        return resumable(options)

    vars(session)["engine_command"] = fake_command
    vars(session)["resumable"] = announced_resumable
    blender = ModuleType("plgs.plgs_blender.lift_scene")
    vars(blender)["save_lift"] = slow_save if behaviour == "short, slow save" else save_lift
    sys.modules["bpy"] = sys.modules.get("bpy") or ModuleType("bpy")
    sys.modules["plgs.plgs_blender"] = ModuleType("plgs.plgs_blender")
    sys.modules["plgs.plgs_blender.lift_scene"] = blender
    return run_plgs.main(arguments)


def save_lift(lift: Path, blend: Path) -> None:
    """Stands for Blender's part."""
    blend.write_bytes(b"BLENDER of " + lift.name.encode())


def slow_save(lift: Path, blend: Path) -> None:
    """A Blender that takes its time, once it has told that it is at work."""
    (lift / "saving").touch()
    from tests.waiting import OUTLASTS_S

    time.sleep(OUTLASTS_S)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
