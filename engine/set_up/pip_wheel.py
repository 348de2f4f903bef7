"""pip for an environment whose Python lacks ensurepip, as Debian's does: pip's own wheel, pinned, from the index."""

from __future__ import annotations

import html
import os
import re
import ssl
from base64 import b64encode
from collections.abc import Callable
from hashlib import sha256
from http.client import HTTPException
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit
from urllib.request import Request, urlopen

from ..errors import PlgsError
from ..job import write_atomically

WHEEL = "pip-25.3-py3-none-any.whl"
SHA256 = "9655943313a94722b7774661c21049070f6bbb0a1516bf02f7c8d5d9201514cd"
PUBLIC = "https://pypi.org/simple"
_MOST_BYTES, _AT_ONCE, _PATIENCE_S = 20_000_000, 1 << 16, 15.0


def fetch_pip(folder: Path, index_url: str, pause: Callable[[], object]) -> Path:
    """Download pip's wheel into a folder; ``pause`` is called in between, and what it raises ends it.

    An empty ``index_url`` is the variable PIP_INDEX_URL, else PyPI: the file with pip's configuration needs pip. Raises
    PlgsError where the index does not give the pinned file, OSError where the folder cannot be written.
    """
    index = (index_url or os.environ.get("PIP_INDEX_URL") or PUBLIC).rstrip("/") + "/pip/"
    fix = "Check the connection and the package index, or install Python with ensurepip."
    try:
        page = _read(index, pause).decode(errors="replace")
        link = re.search(rf'href="((?:[^"]*/)?{re.escape(WHEEL)}[^"]*)"', page)
        content = _read(urljoin(index, html.unescape(link[1])), pause) if link else b""
    except (OSError, ValueError, HTTPException) as error:
        raise PlgsError("pip-download", f"pip could not be downloaded ({error})", "the package index", fix) from error
    if sha256(content).hexdigest() != SHA256:
        raise PlgsError("no-pip-wheel", f"has no {WHEEL} as it is pinned here", "the package index", fix)
    write_atomically(folder / WHEEL, content)
    return folder / WHEEL


def _read(url: str, pause: Callable[[], object]) -> bytes:
    """At most _MOST_BYTES of what is there. A name and a password before the host are sent as pip sends them. Raises
    OSError, ValueError, HTTPException."""
    trusted = ssl.create_default_context(cafile=os.environ.get("PIP_CERT") or None)
    parts, content = urlsplit(url), bytearray()
    request = Request(parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl())
    if parts.username:
        login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        request.add_unredirected_header("Authorization", f"Basic {b64encode(login.encode()).decode()}")
    with urlopen(request, timeout=_PATIENCE_S, context=trusted) as answer:
        while len(content) < _MOST_BYTES and (more := answer.read(_AT_ONCE)):
            content += more
            pause()
    return bytes(content)
