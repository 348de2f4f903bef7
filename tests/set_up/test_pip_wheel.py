"""pip's wheel, from any index that pip itself would take it from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from engine.set_up import pip_wheel
from tests.raises_key import raises_key

CONTENT = b"a wheel"


class Index(BaseHTTPRequestHandler):
    """A plain folder of files, for those who know "me" and "p@ss"."""

    def do_GET(self) -> None:
        is_known = self.headers["Authorization"] == "Basic bWU6cEBzcw=="
        self.send_response(200 if is_known else 401)
        self.end_headers()
        if is_known:
            self.wfile.write(CONTENT if self.path.endswith(".whl") else f'<a href="{pip_wheel.WHEEL}">'.encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def host() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Index)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_a_password_in_the_address_is_sent(host: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pip_wheel, "SHA256", hashlib.sha256(CONTENT).hexdigest())
    found = pip_wheel.fetch_pip(tmp_path, f"http://me:p%40ss@{host}/simple", lambda: None)
    assert found.read_bytes() == CONTENT
    with raises_key("pip-download 401"):
        pip_wheel.fetch_pip(tmp_path, f"http://{host}/simple", lambda: None)


@pytest.mark.parametrize("url", ["http://me:secret@bad host/simple", "http://me:secret@host:port/simple", "nonsense"])
def test_an_address_that_is_none_is_one_line_without_its_password(url: str, tmp_path: Path) -> None:
    with raises_key("pip-download") as error:
        pip_wheel.fetch_pip(tmp_path, url, lambda: None)
    assert "secret" not in str(error.value) and "\n" not in str(error.value)
