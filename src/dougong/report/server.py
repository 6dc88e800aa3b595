"""Clouds of any size in the browser: a server for this computer alone that answers byte ranges."""

import http.server
import json
import re
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from dougong.errors import DougongError

HOST = "127.0.0.1"
_PIECE = 1 << 18
_MOST_SENT = 1 << 20
# The decoder is compiled in the page, which its loader does with code made at run time.
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """One thing the server hands out: bytes, or a file by ranges."""

    kind: str
    body: bytes | Path


Take = Callable[[Any], dict[str, Any]]
"""Takes a JSON document that the page sends; returns what to answer."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: "_Server"

    def do_GET(self) -> None:
        """Answer with a whole page or a range of a file."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer with the headers alone."""
        self._answer(with_body=False)

    def do_POST(self) -> None:
        """Take a JSON document from our own page, and from no other."""
        self.close_connection = True  # what is refused is not read either
        take = self.server.takes.get(self.path.partition("?")[0])
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        length = self.headers.get("Content-Length", "")
        if host not in self.server.hosts or origin != f"http://{host}":
            self._refuse(403)
        elif take is None:
            self._refuse(404)
        elif self.headers.get_content_type() != "application/json":
            self._refuse(415)
        elif not length.isdigit() or int(length) > _MOST_SENT:
            self._refuse(413)
        else:
            try:
                said = take(json.loads(self.rfile.read(int(length))))
                code = 200
            except (DougongError, ValueError) as error:
                said, code = {"error": " ".join(str(error).split())}, 400
            body = json.dumps(said).encode()
            self._head(code, "application/json", len(body))
            self.wfile.write(body)

    def _answer(self, *, with_body: bool) -> None:
        # A page from elsewhere that points its own name at this computer has the wrong host.
        if self.headers.get("Host") not in self.server.hosts:
            self._refuse(421)
            return
        served = self.server.things.get(self.path.partition("?")[0])
        if served is None:
            self._refuse(404)
        elif isinstance(served.body, bytes):
            self._head(200, served.kind, len(served.body))
            if with_body:
                self.wfile.write(served.body)
        else:
            self._file(served.kind, served.body, with_body=with_body)

    def _file(self, kind: str, path: Path, *, with_body: bool) -> None:
        size = path.stat().st_size
        asked = self.headers.get("Range")
        span = (0, size - 1) if asked is None else byte_range(asked, size)
        if span is None:
            self._refuse(416, ("Content-Range", f"bytes */{size}"))
            return
        first, last = span
        extra = [("Accept-Ranges", "bytes")]
        if asked is not None:
            extra.append(("Content-Range", f"bytes {first}-{last}/{size}"))
        self._head(200 if asked is None else 206, kind, last - first + 1, *extra)
        if with_body:
            self.server.count(last - first + 1)
            with path.open("rb") as file:
                file.seek(first)
                self._send(file, last - first + 1)

    def _send(self, file: BinaryIO, left: int) -> None:
        while left:
            piece = file.read(min(_PIECE, left))
            if not piece:
                # The file has shrunk meanwhile: fewer bytes than said, so the connection is over.
                self.close_connection = True
                return
            self.wfile.write(piece)
            left -= len(piece)

    def _head(self, code: int, kind: str, length: int, *extra: tuple[str, str]) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        for name, value in extra:
            self.send_header(name, value)
        self.end_headers()

    def _refuse(self, code: int, *extra: tuple[str, str]) -> None:
        self._head(code, "text/plain", 0, *extra)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: stderr is for the command's own words."""


def byte_range(text: str, size: int) -> tuple[int, int] | None:
    """Return first and last byte of a ``Range`` header for a file of `size`, None where it is bad.

    One range only (RFC 9110, section 14); ``a-b``, ``a-`` and ``-n`` are understood.
    """
    found = re.fullmatch(r"\s*bytes\s*=\s*(\d*)\s*-\s*(\d*)\s*", text)
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        first, last = max(size - int(found[2]), 0), size - 1
    else:
        first, last = int(found[1]), min(int(found[2] or size - 1), size - 1)
    return (first, last) if first <= last else None


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    things: Mapping[str, Served]
    takes: Mapping[str, Take]
    hosts: frozenset[str]
    sent: int
    lock: threading.Lock

    def count(self, sent: int) -> None:
        with self.lock:
            self.sent += sent

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing: a browser that closes a connection early is no error."""


class ViewServer:
    """Serves a page and its clouds on the loopback address until closed.

    Every address begins with a word that cannot be guessed, so that other users and other pages
    of this computer cannot read the clouds.
    """

    def __init__(
        self, things: Mapping[str, Served], port: int = 0, takes: Mapping[str, Take] | None = None
    ) -> None:
        token = secrets.token_urlsafe(12)
        self._server = _Server((HOST, port), _Handler)
        port = self._server.server_address[1]
        self._server.things = {f"/{token}/{name}": served for name, served in things.items()}
        self._server.takes = {f"/{token}/{name}": take for name, take in (takes or {}).items()}
        self._server.sent, self._server.lock = 0, threading.Lock()
        self._server.hosts = frozenset({f"{HOST}:{port}", f"localhost:{port}"})
        self.url = f"http://{HOST}:{port}/{token}/"
        # Looks ten times a second whether it is to end.
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    @property
    def bytes_sent(self) -> int:
        """Bytes of the clouds' files that were asked for so far."""
        return self._server.sent

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
