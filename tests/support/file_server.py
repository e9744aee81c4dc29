"""A file server of this process, which can be cut off, made to fail, or given other files."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Server:
    """What a test wants of the server, and what the server has seen."""

    url: str
    files: dict[str, bytes] = field(default_factory=dict)
    etag: str | None = '"v1"'
    cut_after: int | None = None
    """Bytes after which a connection is cut, each time."""
    redirects: dict[str, str] = field(default_factory=dict)
    status: int | None = None
    """Answer of every request, if it is an error."""
    requests: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    """Path and headers of each."""

    def ranges(self) -> list[str | None]:
        """Which part of a file each request asked for."""
        return [headers.get("Range") for _, headers in self.requests]


class _Handler(BaseHTTPRequestHandler):
    server_state: Server

    def do_GET(self) -> None:
        """Serve a file, or do what the test wants instead."""
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
        """Nothing: a test's output is its own."""


@contextmanager
def serving() -> Iterator[Server]:
    """A server while the block runs."""

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
