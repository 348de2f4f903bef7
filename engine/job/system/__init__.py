"""What differs between POSIX and Windows: locks, processes, folders on disk. The rest of the engine uses this.

`posix` and `windows` have the same functions. Both can be imported everywhere, so each is tested everywhere.
"""

from __future__ import annotations

import sys

if sys.platform == "win32":
    from . import windows as system
else:
    from . import posix as system

try_lock = system.try_lock
flush_folder = system.flush_folder
start_options = system.start_options
kill_with_children = system.kill_with_children
usable_cpus = system.usable_cpus
peak_bytes = system.peak_bytes
OPEN_FILES_KEEP_NAMES = system.OPEN_FILES_KEEP_NAMES
