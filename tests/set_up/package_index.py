"""A package index on this machine: tiny wheels, and downloads that stall, break off or are garbage."""

import base64
import hashlib
import importlib.metadata
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from typing import Any

from tests.waiting import OUTLASTS_S


def wheel(package: str, version: str, module: str) -> tuple[str, bytes]:
    """Name and content of a wheel whose module says its version and nothing else."""
    stem = f"{package.replace('-', '_')}-{version}"
    files = {
        f"{module}/__init__.py": f"__version__ = {version!r}\n",
        f"{stem}.dist-info/METADATA": f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n",
        f"{stem}.dist-info/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(
        f"{name},sha256={base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b'=').decode()},\n"
        for name, text in files.items()
    )
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, text in {**files, f"{stem}.dist-info/RECORD": record}.items():
            archive.writestr(name, text)
    return f"{stem}-py3-none-any.whl", content.getvalue()


def installed(package: str) -> tuple[str, bytes]:
    """Name and content of a wheel with the files of a package of this Python."""
    distribution, content = importlib.metadata.distribution(package), BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for path in distribution.files or []:
            if ".." not in path.parts and path.name != "RECORD" and path.suffix != ".pyc":
                archive.write(path.locate(), str(path))
        archive.writestr(f"{package}-{distribution.version}.dist-info/RECORD", "")
    return f"{package}-{distribution.version}-py3-none-any.whl", content.getvalue()


class PackageIndex:
    """``fault`` maps a package to "stall" (at half, until `go_on`), "cut" (at half), "garbage" or "elsewhere"
    (redirected)."""

    def __init__(self, packages: dict[str, tuple[str, str]]) -> None:
        """``packages``: version and module of each name."""
        self.wheels = {name: wheel(name, version, module) for name, (version, module) in packages.items()}
        self.fault: dict[str, str] = {}
        self.go_on = threading.Event()
        self.stalled = threading.Event()
        self.downloads: list[str] = []
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self._server.server_port}/simple"

    def close(self) -> None:
        self.go_on.set()
        self._server.shutdown()
        self._server.server_close()

    def hashes(self, without: str = "", only: str = "") -> str:
        """As requirements/hashes-*.txt has them."""
        lines = []
        for name, (file, content) in self.wheels.items():
            if name != without and only in ("", name):
                lines.append(f"{name}=={file.split('-')[1]} --hash=sha256:{hashlib.sha256(content).hexdigest()}\n")
        return "".join(lines)

    def _page(self, name: str) -> bytes | None:
        found = [file for package, (file, _) in self.wheels.items() if package.lower() == name]
        return "".join(f'<a href="/files/{file}">{file}</a>' for file in found).encode() if found else None

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        index = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                kind, _, name = self.path.strip("/").partition("/")
                if kind == "simple":
                    page = index._page(name)
                    self._answer(200 if page else 404, "text/html", page or b"none")
                    return
                if kind == "other":
                    self._answer(200, "application/octet-stream", wheel("other", "1.0", "other")[1])
                    return
                package = next(package for package, (file, _) in index.wheels.items() if file == name)
                index.downloads.append(package)
                self._send_wheel(index.wheels[package][1], index.fault.get(package))

            def _send_wheel(self, content: bytes, fault: str | None) -> None:
                if fault == "elsewhere":
                    self.send_response(302)
                    self.send_header("Location", "/other")
                    self.end_headers()
                    return
                if fault == "garbage":
                    content = b"\0" * len(content)
                self._answer(200, "application/octet-stream", content, send=len(content) // 2 if fault else None)
                if fault == "stall":
                    index.stalled.set()
                    index.go_on.wait(OUTLASTS_S)
                    self.wfile.write(content[len(content) // 2 :])
                elif fault == "garbage":
                    self.wfile.write(content[len(content) // 2 :])

            def _answer(self, code: int, kind: str, content: bytes, send: int | None = None) -> None:
                self.send_response(code)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content[:send])
                self.wfile.flush()

            def log_message(self, *_: Any) -> None:
                pass

        return Handler
