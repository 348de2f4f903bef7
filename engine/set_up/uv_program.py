"""uv, the program that makes environments and installs packages: its pinned wheel from the package index, and its
environment variables.

This imports nothing of PLGS, and any Python from 3.8 on can run it: the set-up of a clone begins with it, too."""

from __future__ import annotations

import configparser
import hashlib
import html
import io
import os
import platform
import re
import ssl
import sys
import zipfile
from base64 import b64encode
from collections.abc import Mapping
from http.client import HTTPException
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit
from urllib.request import Request, urlopen

VERSION = "0.13.9"
# The end of a wheel's name, and the wheel's SHA-256, by what Python calls the system and the processor.
_WHEELS = {
    ("linux", "x86_64"): (
        "manylinux_2_17_x86_64.manylinux2014_x86_64.whl",
        "d7f459fe4fd247d830351c75686d3996ace3c6f3f728eb0e85a30b7ada0cef19",
    ),
    ("linux", "aarch64"): (
        "manylinux_2_28_aarch64.whl",
        "ecb6028d79dc96fbeafffe5c8af62a7099487ebc05a701e76714eebcffd06375",
    ),
    ("darwin", "arm64"): ("macosx_11_0_arm64.whl", "66c512266d633bef48384a1f53003f41f2a8e7b36fe6e7fbfd3e0fd52d96fa63"),
    ("win32", "amd64"): ("win_amd64.whl", "6a44b2ed8111d2f60d2b92627c5dccda3f7ed7570b18ce115e569cd68c28246b"),
}
_PUBLIC = "https://pypi.org/simple"
_MOST_BYTES, _AT_ONCE, _PATIENCE_S = 60_000_000, 1 << 16, 15.0
# What uv calls the settings of pip, which users have for mirrors and proxies.
_OF_PIP = {
    "index-url": "UV_DEFAULT_INDEX", "extra-index-url": "UV_INDEX", "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX", "trusted-host": "UV_INSECURE_HOST", "cert": "SSL_CERT_FILE", "proxy": "ALL_PROXY",
    "timeout": "UV_HTTP_TIMEOUT", "default-timeout": "UV_HTTP_TIMEOUT", "retries": "UV_HTTP_RETRIES",
}  # fmt: skip
_LEFT_OUT = re.compile(
    r"PYTHON(PATH|HOME|DONTWRITEBYTECODE)$|VIRTUAL_ENV$|CONDA_PREFIX$|"
    r"UV_(PYTHON|SYSTEM_PYTHON|TARGET|PREFIX|CONSTRAINT|OVERRIDE|EXCLUDE|PROJECT|WORKING_DIR)$"
)
"""Variables that would send packages elsewhere than into the environment, or bring in others."""

_DIVERTING = ("target", "prefix", "python", "system", "require-hashes")
"""Settings under [pip] in uv's files that change where packages go, or forbid what has no hash."""


def variables(environ: Mapping[str, str], index_url: str = "") -> dict[str, str]:
    """Return ``environ`` for uv, with the user's pip settings where uv has none. ``index_url`` replaces PyPI. It is no
    command-line argument, as the list of processes would show its password."""
    kept = {name: value for name, value in environ.items() if not _LEFT_OUT.match(name)}
    for setting, name in _OF_PIP.items():
        if value := _setting_of_pip(setting, environ):
            kept.setdefault(name, ",".join(value.split()) if setting == "find-links" else value)
    if "UV_INDEX" in kept:  # pip takes the best of all indexes
        kept.setdefault("UV_INDEX_STRATEGY", "unsafe-best-match")
    if index_url:
        kept["UV_DEFAULT_INDEX"] = index_url
    return {"UV_SYSTEM_CERTS": "1", "UV_NO_PROGRESS": "1", **kept}


def diverted(environ: Mapping[str, str], folder: Path) -> str:
    """Describe the first setting of uv that would install somewhere else or that the set-up cannot meet (torch comes
    without hashes); "" if there is none. ``folder`` is where uv runs: it also reads settings in the folders above. uv
    has no option that overrides these alone. A Python before 3.11 cannot read uv's files and finds none."""
    if environ.get("UV_REQUIRE_HASHES", "0").lower() not in ("", "0", "false"):
        return "UV_REQUIRE_HASHES"
    if find_spec("tomllib") is None:
        return ""
    import tomllib

    home = Path(os.path.expanduser("~"))
    users = Path(environ.get("APPDATA" if os.name == "nt" else "XDG_CONFIG_HOME") or home / ".config")
    systems = [Path(each) for each in environ.get("XDG_CONFIG_DIRS", "/etc/xdg").split(os.pathsep) if each]
    systems += [Path("/etc"), Path(environ.get("PROGRAMDATA") or "/nowhere")]
    files = [each / name for each in (folder, *folder.parents) for name in ("uv.toml", "pyproject.toml")]
    files += [each / "uv" / "uv.toml" for each in (users, *systems)]
    for path in [Path(environ["UV_CONFIG_FILE"])] if environ.get("UV_CONFIG_FILE") else files:
        try:
            content = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # uv names a file that it cannot read
            continue
        inside = ("tool", "uv", "pip") if path.name == "pyproject.toml" else ("pip",)
        for key in inside:
            content = content[key] if isinstance(content.get(key), dict) else {}
        for name in _DIVERTING:
            if content.get(name):
                return f"pip.{name} in {path}"
    return ""


def pip_variables(variables: Mapping[str, str]) -> dict[str, str]:
    """Return uv's ``variables`` for pip, which then reads no settings of the user's."""
    kept = {name: value for name, value in variables.items() if not name.startswith("PIP_")}
    for setting, name in _OF_PIP.items():
        if value := variables.get(name):
            kept["PIP_" + setting.upper().replace("-", "_")] = " ".join(value.split(","))
    return {**kept, "PIP_CONFIG_FILE": os.devnull}


def program_in(folder: Path) -> Path:
    """Return the path of uv in the folder in which `fetch` puts it."""
    return folder / f"uv-{VERSION}" / ("uv.exe" if os.name == "nt" else "uv")


def fetch(folder: Path, variables: Mapping[str, str]) -> Path:
    """Return the path of uv in a folder, downloaded if it is not there. Raises OSError with one line for the user."""
    program = program_in(folder)
    if program.exists():
        return program
    name, digest = pinned_wheel()
    try:
        content = _wheel(name, variables)
    except (OSError, ValueError, HTTPException) as error:
        raise OSError(f"uv could not be downloaded ({error})") from error
    if hashlib.sha256(content).hexdigest() != digest:
        raise OSError(f"the package index, or the folder of wheels, has no {name} with the pinned hash")
    program.parent.mkdir(parents=True, exist_ok=True)
    part = program.with_suffix(".part")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        part.write_bytes(archive.read(f"uv-{VERSION}.data/scripts/{program.name}"))
    part.chmod(0o755)  # zipfile keeps no modes
    part.replace(program)
    return program


def pinned_wheel() -> tuple[str, str]:
    """Return the name and the SHA-256 of uv's wheel for this system. Raises OSError if there is none."""
    system = (sys.platform, platform.machine().replace("AMD64", "amd64"))
    if system not in _WHEELS:
        raise OSError(f"uv is not available for {system[0]} on {system[1]}")
    ending, digest = _WHEELS[system]
    return f"uv-{VERSION}-py3-none-{ending}", digest


def _wheel(name: str, variables: Mapping[str, str]) -> bytes:
    """Return the wheel's bytes, from a folder of the user's wheels or from the index; b"" if neither has it."""
    for folder in variables.get("UV_FIND_LINKS", "").split(","):
        if folder and (Path(folder) / name).is_file():
            return (Path(folder) / name).read_bytes()
    if variables.get("UV_NO_INDEX", "0").lower() not in ("", "0", "false"):
        return b""
    index = variables.get("UV_DEFAULT_INDEX", _PUBLIC).rstrip("/") + "/uv/"
    page = _read(index, variables).decode(errors="replace")
    link = re.search(rf'href="((?:[^"]*/)?{re.escape(name)}[^"]*)"', page)
    return _read(urljoin(index, html.unescape(link[1])), variables) if link else b""


def _read(url: str, variables: Mapping[str, str]) -> bytes:
    """Download at most _MOST_BYTES. A name and a password before the host are sent as uv sends them. Raises OSError,
    ValueError, HTTPException."""
    trusted = ssl.create_default_context(cafile=variables.get("SSL_CERT_FILE"))
    parts, content = urlsplit(url), bytearray()
    request = Request(parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl())  # urllib takes no logins
    if parts.username:
        login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        request.add_unredirected_header("Authorization", f"Basic {b64encode(login.encode()).decode()}")
    with urlopen(request, timeout=_PATIENCE_S, context=trusted) as answer:
        while len(content) < _MOST_BYTES and (more := answer.read(_AT_ONCE)):
            content += more
    return bytes(content)


def _setting_of_pip(name: str, environ: Mapping[str, str]) -> str:
    """Return a setting of the user's pip, from its environment variable or its files; "" without one."""
    if value := environ.get("PIP_" + name.upper().replace("-", "_")):
        return value
    home = Path(os.path.expanduser("~"))
    files = [
        environ.get("PIP_CONFIG_FILE") or os.devnull,
        Path(environ.get("XDG_CONFIG_HOME") or home / ".config") / "pip" / "pip.conf",
        home / "Library/Application Support/pip/pip.conf",
        Path(environ.get("APPDATA") or home) / "pip" / "pip.ini",
        home / ".pip/pip.conf",
        "/etc/xdg/pip/pip.conf",
        "/etc/pip.conf",
    ]
    for path in files[:1] if environ.get("PIP_CONFIG_FILE") == os.devnull else files:  # pip: no file at all
        parser = configparser.RawConfigParser()  # others would interpolate "%", which URLs may hold
        try:
            parser.read(str(path), encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError):
            continue
        for section in ("install", "global"):
            if value := parser.get(section, name, fallback=""):
                return value.strip().strip("'\"")
    return ""


if __name__ == "__main__":  # in a process of its own, which can be ended while an index is silent
    try:
        fetch(Path(sys.argv[1]), os.environ)
    except OSError as error:
        sys.exit(f"error: {error}")
