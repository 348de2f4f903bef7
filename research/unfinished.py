"""Score a lift that is still in training as if it ended now: a copy of it is finished without another step."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from engine.errors import PlgsError
from engine.job import EventWriter, LiftFolder, StopSignal
from engine.job.report import metrics_text, read_metrics
from engine.lift.run import run_lift
from engine.plates import make_fills
from engine.train.trainer import Trainer


class EndedTraining(Trainer):
    """A trainer that takes no further step, for finishing a lift as it is."""

    @property
    def finished(self) -> bool:
        return True


def unfinished_scores(lift: Path) -> Iterator[str]:
    """Yield the step of the newest checkpoint, and the tables of scores on held-out frames. The lift may go on
    meanwhile. Raises PlgsError if there is no checkpoint; OSError."""
    folder = LiftFolder.open(lift)
    newest = folder.checkpoints.latest()
    if newest is None:
        raise PlgsError("no-checkpoint", "has no checkpoint yet", lift, "Let it train for a minute, then ask again.")
    yield f"after step {newest.state['step']}:"
    with TemporaryDirectory(dir=lift.parent) as name:
        copy = LiftFolder.create(Path(name, "lift"), replace(folder.request, bake="test"))
        shutil.copytree(newest.path, copy.path / "checkpoint")
        with closing(EventWriter(copy.events_path)) as events:
            run_lift(copy, events, StopSignal(), resume=True, make_fills=make_fills, training=EndedTraining)
        yield metrics_text(read_metrics(copy))
