"""An engine process for tests: the real `run_engine` around a lift that only pretends. Run as a script:

fake_engine.py BEHAVIOUR LIFT [--resume] [--stay-with-parent]: what `engine lift LIFT` would be.
"""

import ctypes
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from engine.command_line.run_engine import run_engine
from engine.errors import PlgsError
from engine.job import EventWriter, LiftFolder, StopSignal
from tests.job.following import tiny_lift
from tests.waiting import OUTLASTS_S

STEP_S = 0.02


class Pretence:
    """A lift of many short steps that counts in its checkpoint; ``behaviour`` says what goes wrong."""

    def __init__(self, behaviour: str) -> None:
        self.behaviour = behaviour

    def __call__(self, folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
        print("python talks")
        os.write(1, b"native code talks\n")
        if self.behaviour == "bad input":
            raise PlgsError("made-up", "is too dark", folder.request.scene, "Switch the light on.")
        events.stage("train", 1, 2, "Training")
        checkpoint = folder.checkpoints.latest() if resume else None
        step = 0 if checkpoint is None else int(str(checkpoint.state["step"]))
        steps = 10 if self.behaviour.startswith("short") else round(OUTLASTS_S / STEP_S)
        while step < steps:
            step += 1
            folder.checkpoints.save({"step": step}, lambda path: (path / "model").write_bytes(b"model"))
            events.progress("train", step, steps, loss=1.0 / step, eta_s=STEP_S * (steps - step))
            self.go_wrong(step)
            if self.behaviour != "deaf":
                stop.check()
            time.sleep(0.0 if self.behaviour.endswith("at once") else STEP_S)
        tiny_lift(folder, events, stop, resume=resume)

    def go_wrong(self, step: int) -> None:
        if step < 5:
            return
        match self.behaviour:
            case "deaf":
                time.sleep(OUTLASTS_S)
            case "holds the lock":  # native code that keeps every other Python thread from running
                ctypes.PyDLL(None).sleep(int(OUTLASTS_S))
            case "broken":
                raise ZeroDivisionError("no such luck")
            case "memory":
                raise MemoryError
            case "memory of torch":
                import torch

                torch.empty(1 << 50)
            case "segfault":
                ctypes.string_at(0)
            case "exits":
                os._exit(7)


if __name__ == "__main__":
    behaviour, lift = sys.argv[1:3]
    folder = LiftFolder.open(Path(lift))
    try:
        pipe = 0 if "--stay-with-parent" in sys.argv else None
        code = run_engine(folder, resume="--resume" in sys.argv, parent_pipe=pipe, lift=Pretence(behaviour))
    except PlgsError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    sys.exit(code)
