"""Addresses may carry a user's name and password: logs and messages do without."""

from __future__ import annotations

import re

_USER = re.compile(r"(?<=://)[^/@\s]+@")


def without_credentials(text: str) -> str:
    """The text with ``****`` where an address names a user or a password."""
    return _USER.sub("****@", text)
