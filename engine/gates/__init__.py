"""What comes from other people passes here first: files, names, texts. Standard library only."""

from __future__ import annotations

from .credentials import without_credentials
from .inner_path import inner_path
from .plain_file import create_plain, open_plain, open_to_append, read_plain, refuse_special
from .printable import printable

__all__ = [
    "create_plain",
    "inner_path",
    "open_plain",
    "open_to_append",
    "printable",
    "read_plain",
    "refuse_special",
    "without_credentials",
]
