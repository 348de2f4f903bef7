"""What may go wrong by the user's input or the machine: errors that say what is wrong, where, and what to do."""

from __future__ import annotations

from ..engine.job import JobError
from ..engine.scene import SceneError

EXPECTED = (JobError, SceneError, OSError)
"""An operator reports these in one line. Anything else is a defect of ours and shows its traceback."""
