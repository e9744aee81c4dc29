"""Local file server that can cut connections, return errors, or serve other files."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Server:
    """Settings of the file server and a record of its requests."""

    url: str
    files: dict[str, bytes] = field(default_factory=dict)
    etag: str | None = '"v1"'
    cut_after: int | None = None
    """Number of bytes after which the server cuts each connection."""
    redirects: dict[str, str] = field(default_factory=dict)
    status: int | None = None
    """HTTP status of every response, if it is an error."""
    requests: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    """Path and headers of each request."""

    def ranges(self) -> list[str | None]:
        """Return the requested byte range of each request."""
        return [headers.get("Range") for _, headers in self.requests]


class _Handler(BaseHTTPRequestHandler):
    server_state: Server

    def do_GET(self) -> None:
        """Serve a file, or respond as the settings of the server define."""
        state = self.server_state
        state.requests.append((self.path, dict(self.headers)))
        if state.status:
            return self.send_error(state.status)
        if self.path in state.redirects:
            self.send_response(302)
            self.send_header("Location", state.redirects[self.path])
            return self.end_headers()
        if self.path not in state.files:
            return self.send_error(404)
        content, start = state.files[self.path], 0
        same = self.headers.get("If-Range") in (None, state.etag)
        if same and "Range" in self.headers:
            start = int(self.headers["Range"].removeprefix("bytes=").removesuffix("-"))
        if start >= len(content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            return self.end_headers()
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        if state.etag:
            self.send_header("ETag", state.etag)
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        stop = len(content) if state.cut_after is None else start + state.cut_after
        self.wfile.write(content[start:stop])

    def log_message(self, *args: object) -> None:
        """Log nothing, because requests would clutter the output of the test."""


@contextmanager
def serving() -> Iterator[Server]:
    """Run a file server for a block of code."""

    class OwnHandler(_Handler):
        pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), OwnHandler)
    OwnHandler.server_state = Server(f"http://127.0.0.1:{http.server_port}")
    thread = threading.Thread(target=http.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield OwnHandler.server_state
    finally:
        http.shutdown()
        thread.join()
        http.server_close()
