"""The request, the progress and the outcome of a lift. It uses only the standard library."""

from __future__ import annotations

from ..errors import ExitCode
from .atomic import ListedFile, sha256, write_atomically
from .cameras import BakeCamera, read_cameras
from .checkpoint import Checkpoint, CheckpointStore
from .events import Event, EventReader, EventWriter, last_run
from .folder import LiftFolder, LiftState, refuse_used
from .lock import BakeLocks
from .manifest import (
    Manifest,
    add_files,
    check_sizes,
    drop_files,
    read_manifest,
    verify,
    verify_files,
    verify_lifted,
    write_manifest,
)
from .request import BAKES, CHANNELS, FURTHER_LAYERS, LiftRequest
from .task import StopSignal, Watchdog
