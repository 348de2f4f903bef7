"""``export``: a finished lift in the forms that other programs read."""

from __future__ import annotations

import argparse
import sys

from ..job import ExitCode, LiftFolder


def export_lift(options: argparse.Namespace) -> ExitCode:
    """Write it, and tell where. Raises JobError, SceneError."""
    from ..export import export

    folder = LiftFolder.open(options.lift)
    try:
        export(folder, options.to, options.output, options.frames, count_frames=options.progress)
    except KeyboardInterrupt:
        print("Stopped. What was exported so far is there.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    print(f"Exported to {options.output}")
    return ExitCode.FINISHED
