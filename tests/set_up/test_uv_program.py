"""uv's wheel, from wherever the user's packages come from, and the variables that uv gets."""

import hashlib
import io
import os
import platform
import sys
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from engine.set_up import uv_program

NAME = next(
    f"uv-{uv_program.VERSION}-py3-none-{ending}"
    for (system, _), (ending, _) in uv_program._WHEELS.items()
    if system == sys.platform and platform.machine() in ending
)


def content(text: str) -> bytes:
    """A wheel whose uv is a text."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(zipfile.ZipInfo(f"uv-{uv_program.VERSION}.data/scripts/uv"), text)
    return packed.getvalue()


class Index(BaseHTTPRequestHandler):
    """A plain folder of files, for those who know "me" and "p@ss"."""

    def do_GET(self) -> None:
        is_known = self.headers["Authorization"] == "Basic bWU6cEBzcw=="
        self.send_response(200 if is_known else 401)
        self.end_headers()
        if is_known:
            self.wfile.write(content("a wheel") if self.path.endswith(".whl") else f'<a href="{NAME}">'.encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def host() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Index)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def pin(monkeypatch: pytest.MonkeyPatch, wheel: bytes) -> None:
    pinned = {key: (ending, hashlib.sha256(wheel).hexdigest()) for key, (ending, _) in uv_program._WHEELS.items()}
    monkeypatch.setattr(uv_program, "_WHEELS", pinned)


def variables(index_url: str) -> dict[str, str]:
    return uv_program.variables({"PIP_CONFIG_FILE": os.devnull}, index_url)


def test_a_password_in_the_index_address_is_sent(host: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = variables(f"http://me:p%40ss@{host}/simple")
    with pytest.raises(OSError, match="with the pinned hash"):
        uv_program.fetch(tmp_path, known)
    pin(monkeypatch, content("a wheel"))
    assert uv_program.fetch(tmp_path, known).read_text() == "a wheel"
    with pytest.raises(OSError, match="401"):
        uv_program.fetch(tmp_path / "other", variables(f"http://{host}/simple"))


@pytest.mark.parametrize("url", ["http://me:secret@bad host/simple", "http://me:secret@host:port/simple", "nonsense"])
def test_an_invalid_index_address_is_reported_without_its_password(url: str, tmp_path: Path) -> None:
    with pytest.raises(OSError, match="could not be downloaded") as error:
        uv_program.fetch(tmp_path, variables(url))
    assert "secret" not in str(error.value) and "\n" not in str(error.value)


def test_a_set_up_from_a_folder_of_wheels_needs_no_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / NAME).write_bytes(content("another"))
    pin(monkeypatch, content("another"))
    offline = {**variables("http://127.0.0.1:9"), "UV_FIND_LINKS": f"/nowhere,{tmp_path}"}
    assert uv_program.fetch(tmp_path / "tools", offline).read_text() == "another"


def test_settings_of_pip_are_used_unless_uv_has_its_own(tmp_path: Path) -> None:
    (tmp_path / "pip.conf").write_text(
        "[global]\nindex-url = http://mirror\nfind-links = /a\n  /b\n[install]\ncert=/c\n"
    )
    environ = {"PIP_CONFIG_FILE": str(tmp_path / "pip.conf"), "PIP_PROXY": "http://proxy", "UV_PYTHON": "3.8"}
    told = uv_program.variables(environ | {"PIP_EXTRA_INDEX_URL": "http://x http://y", "UV_CONSTRAINT": "c.txt"})
    assert told["UV_DEFAULT_INDEX"] == "http://mirror" and told["UV_FIND_LINKS"] == "/a,/b"
    assert told["SSL_CERT_FILE"] == "/c" and told["ALL_PROXY"] == "http://proxy"
    assert told["UV_INDEX"] == "http://x http://y" and told["UV_INDEX_STRATEGY"] == "unsafe-best-match"
    assert "UV_PYTHON" not in told and "UV_CONSTRAINT" not in told
    assert uv_program.variables(environ | {"UV_DEFAULT_INDEX": "http://mine"})["UV_DEFAULT_INDEX"] == "http://mine"
    assert uv_program.variables(environ, "http://given")["UV_DEFAULT_INDEX"] == "http://given"


@pytest.mark.parametrize("name", ["target", "prefix", "python", "system", "require-hashes"])
@pytest.mark.parametrize("where", ["user", "system", "folder", "project", "named"])
def test_a_setting_of_uv_that_redirects_packages_is_found(name: str, where: str, tmp_path: Path) -> None:
    folder = tmp_path / "above" / "engine"
    environ = {"XDG_CONFIG_HOME": str(tmp_path / "user"), "XDG_CONFIG_DIRS": str(tmp_path / "system")}
    path = {
        "user": tmp_path / "user" / "uv" / "uv.toml",
        "system": tmp_path / "system" / "uv" / "uv.toml",
        "folder": folder.parent / "uv.toml",
        "project": folder.parent / "pyproject.toml",
        "named": tmp_path / "studio.toml",
    }[where]
    section = "tool.uv.pip" if where == "project" else "pip"
    for setting in ('index-url = "http://mirror"', f'{name} = "here"'):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"[{section}]\n{setting}\n")
        found = uv_program.diverted(environ | ({"UV_CONFIG_FILE": str(path)} if where == "named" else {}), folder)
        assert found == (f"pip.{name} in {path}" if name in setting else "")
    assert uv_program.diverted({"UV_CONFIG_FILE": str(tmp_path / "none"), "UV_REQUIRE_HASHES": "1"}, folder)
