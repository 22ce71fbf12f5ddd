"""A small web server for pages that test the modules of pebble/web/static/media."""

from __future__ import annotations

import itertools
import struct
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from tests.support import ROOT

STATIC = ROOT / "pebble" / "web" / "static"
PAGES = Path(__file__).parent / "pages"
_TYPES = {".js": "text/javascript", ".html": "text/html"}


class MediaPages:
    """Serves the page's modules, the test's pages, and byte strings; takes byte strings that a page posts."""

    def __init__(self) -> None:
        self.posted: dict[str, bytes] = {}
        self._data: dict[str, bytes] = {}
        self._names = itertools.count()
        pages = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                pages.answer(self)

            def do_POST(self) -> None:
                pages.posted[self.path] = self.rfile.read(int(self.headers["content-length"]))
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_args: object) -> None:
                """Log nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def offer(self, data: bytes) -> str:
        """Serve ``data``; returns its path."""
        name = f"/data/{next(self._names)}"
        self._data[name] = data
        return name

    def offer_list(self, parts: Sequence[bytes]) -> str:
        """Serve several byte strings, each behind its length."""
        return self.offer(b"".join(struct.pack(">I", len(part)) + part for part in parts))

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        path = request.path
        file = (STATIC if path.startswith(("/media/", "/core/")) else PAGES) / path.lstrip("/")
        data = self._data.get(path)
        if data is None and file.is_file():
            data = file.read_bytes()
        request.send_response(404 if data is None else 200)
        request.send_header("content-type", _TYPES.get(file.suffix, "application/octet-stream"))
        request.send_header("content-length", str(len(data or b"")))
        request.end_headers()
        request.wfile.write(data or b"")
