"""A local web server for one scene: the page, and the scene's integers on demand.

Only the standard library; nothing is fetched from elsewhere, plain http suffices, and the page may not load anything
from another origin.
"""

from __future__ import annotations

import errno
import json
import re
import sys
import threading
import time
import webbrowser
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2

from packuv.viewer.bodies import Bodies
from packuv.viewer.source import Source, Truth, describe, open_source

PAGES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/viewer.js": ("viewer.js", "text/javascript; charset=utf-8"),
    "/splats.js": ("splats.js", "text/javascript; charset=utf-8"),
    "/navigation.js": ("navigation.js", "text/javascript; charset=utf-8"),
    "/film.js": ("film.js", "text/javascript; charset=utf-8"),
    "/worker.js": ("worker.js", "text/javascript; charset=utf-8"),
}
"""Path to file beside this module and its type; nothing else on disk is reachable"""

BINARY, JSON = "application/octet-stream", "application/json"
SOUND = "/sound.flac"
PICTURE = re.compile(r"/truth/([^/]{1,600})/(0|[1-9][0-9]{0,8})\.png")
NUMBERED = re.compile(r"/(segments|frames|layers)/(0|[1-9][0-9]{0,8})(?:/(0|[1-9][0-9]{0,3}))?\.bin")

POLICY = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; media-src blob:"
"""Content security policy: a page that tries to reach another origin fails at once"""

STATE = re.compile(r"(?:^|&)made=(\d+)(?:&|$)")
"""In a query: the state of a growing scene that the page knows"""

PATIENCE_SECONDS = 30
"""How long a connection may say nothing"""
MOST_CONNECTIONS = 64
"""At a time; a browser opens six"""

LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


def serve(
    scene_path: Path,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = False,
    announce: Callable[[str], object] | None = None,
    worst: int | None = None,
    truth: Truth | None = None,
) -> None:
    """Show a scene file in the browser until interrupted.

    Port 0 takes any free port. `announce` gets the address once it answers; by default it is printed. `worst` is a
    frame to mark as the one with the lowest score, `truth` what to lay beside. Raises FileNotFoundError for a missing
    file, ValueError for one that is no scene, or where the port or the host cannot be had.
    """
    check_port(port)
    with open_source(scene_path) as source, bound(host, port, source, worst=worst, truth=truth) as server:
        answer_until_interrupted(server, open_browser=open_browser, announce=announce)


def check_port(port: int) -> None:
    """Raise ValueError for what is no port."""
    if not 0 <= port < 2**16:
        raise ValueError(f"a port is a number from 0 to {2**16 - 1}, but is {port}")


def answer_until_interrupted(
    server: ViewerServer, *, open_browser: bool, announce: Callable[[str], object] | None = None
) -> None:
    """Serve until Ctrl-C; `announce` gets the address, by default it is printed."""
    announce(server.url) if announce else print(server.url, flush=True)
    if open_browser:
        webbrowser.open(server.url)
    getting_ready = threading.Thread(target=server.bodies.get_ready)
    getting_ready.start()  # while the browser does
    with suppress(KeyboardInterrupt):
        server.serve_forever()
    getting_ready.join()  # it reads the scene file


Grown = Callable[[], tuple[Source, Truth | None] | None]
"""Gives what there is by now of something that grows; None where that is what it gave before"""


def bound(
    host: str,
    port: int,
    source: Source,
    *,
    worst: int | None = None,
    truth: Truth | None = None,
    grown: Grown | None = None,
) -> ViewerServer:
    """A server at this address; raises ValueError where that cannot be had."""
    try:
        return ViewerServer((host, port), source, worst=worst, truth=truth, grown=grown)
    except OSError as error:
        why, cure = error.strerror or str(error), "name another --port, or 0 for a free one"
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            cure = "--host must be an address of this machine, such as 0.0.0.0 for all"
        raise ValueError(f"port {port} of {host} cannot be had: {why}; {cure}") from None


class ViewerServer(ThreadingHTTPServer):
    """Serves one source; the address is bound once constructed, `serve_forever` answers."""

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(
        self,
        address: tuple[str, int],
        source: Source,
        *,
        worst: int | None = None,
        truth: Truth | None = None,
        grown: Grown | None = None,
    ) -> None:
        super().__init__(address, _Handler)
        self.worst, self._grown = worst, grown
        self.source, self.truth, self.bodies = source, truth, Bodies(source)
        self.made = time.time_ns() // 1_000_000
        """Counts the states of what grows, from a number that no server before this one had"""
        self._looking = threading.Lock()
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Hang up on a caller too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that seeks or closes drops its requests; that is no news."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        host, port = self.server_address[:2]
        return f"http://{host!s}:{port}/"

    @property
    def is_loopback(self) -> bool:
        return self.server_address[0] in ("127.0.0.1", "::1")

    def content(self, path: str) -> Content | None:
        """What a path without its query holds; None where there is nothing."""
        if path in PAGES:
            name, kind = PAGES[path]
            return Content(_deflated(Path(__file__).with_name(name).read_bytes()), kind)
        if path == "/scene.json":
            self._look_again()
            growing = {"made": self.made} if self._grown else {}
            marked = {} if self.worst is None else {"worst": self.worst}
            filmed = {"truth": list(self.truth.cameras)} if self.truth else {}
            told = {**describe(self.source), **marked, **filmed, **growing}
            return Content(_deflated(json.dumps(told).encode()), JSON)
        if path == SOUND and (heard := self.source.sound()):
            return Content(zlib.compress(heard, 0), "audio/flac")  # which is packed as it is
        if asked := PICTURE.fullmatch(path):
            return self._filmed(unquote(asked[1]), int(asked[2]))
        if numbered := NUMBERED.fullmatch(path):
            return self._numbered(numbered[1], *(int(number) for number in numbered.groups()[1:] if number))
        return None

    def _look_again(self) -> None:
        with self._looking:
            if self._grown and (now := self._grown()):
                self.made += 1  # first: who has read anything new then finds the state that it asked for over
                self.source, self.truth = now
                self.bodies = Bodies(self.source)

    def is_past(self, query: str) -> bool:
        """Whether a page asks for something of a state that is over: frames had other numbers."""
        known = STATE.search(query)
        return bool(self._grown and known and int(known[1]) != self.made)

    def _filmed(self, camera: str, frame: int) -> Content | None:
        if not self.truth or camera not in self.truth.cameras or frame >= self.source.segments[-1].stop:
            return None
        pixels = self.truth.picture(camera, frame)
        if pixels is None:
            return None
        written = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        return Content(_deflated(written.tobytes()), "image/png")

    def _numbered(self, what: str, *numbers: int) -> Content | None:
        bodies = self.bodies
        made: dict[tuple[str, int], Callable[..., bytes]] = {
            ("segments", 2): bodies.part,
            ("frames", 1): bodies.frame,
            ("layers", 1): bodies.layers,
        }
        make = made.get((what, len(numbers)))
        try:
            return Content(make(*numbers), BINARY) if make else None
        except IndexError:
            return None


@dataclass(frozen=True)
class Content:
    """What an address holds."""

    deflated: bytes
    kind: str


def _deflated(content: bytes) -> bytes:
    return zlib.compress(content, 6)


class _Handler(BaseHTTPRequestHandler):
    server: ViewerServer
    timeout = PATIENCE_SECONDS
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # a body must not wait until its head is acknowledged
    server_version = "packuv"
    _decode_ms: float | None = None
    """That the answer took to be found"""

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def log_message(self, format: str, *args: object) -> None:
        """Silent: the terminal belongs to the command that serves."""

    def _answer(self, *, with_body: bool) -> None:
        if self._is_rebound():
            return self._send(HTTPStatus.FORBIDDEN, b"this viewer answers to localhost only\n", "text/plain", with_body)
        (path, _, query), started = self.path.partition("?"), time.perf_counter()
        try:
            found = self.server.content(path)
        except Exception as error:  # a damaged file must reach the page as words, not as a dropped connection
            message = f"{path}: {error}\n".encode(errors="replace")
            passes = isinstance(error, OSError)  # the page asks again; what is damaged stays so
            status = HTTPStatus.SERVICE_UNAVAILABLE if passes else HTTPStatus.INTERNAL_SERVER_ERROR
            return self._send(status, message, "text/plain; charset=utf-8", with_body)
        if found is None:
            return self._send(HTTPStatus.NOT_FOUND, b"nothing here\n", "text/plain; charset=utf-8", with_body)
        if self.server.is_past(query):
            return self._send(HTTPStatus.GONE, b"there is more by now\n", "text/plain", with_body)
        self._decode_ms = 1000 * (time.perf_counter() - started)
        if "deflate" in self.headers.get("Accept-Encoding", ""):
            return self._send(HTTPStatus.OK, found.deflated, found.kind, with_body, encoding="deflate")
        self._send(HTTPStatus.OK, zlib.decompress(found.deflated), found.kind, with_body)

    def _is_rebound(self) -> bool:
        """True if a name of another site was made to point here: its page must not read the scene."""
        host = re.sub(r":\d+$", "", self.headers.get("Host", "localhost"))
        return self.server.is_loopback and host not in LOOPBACK

    def _send(self, status: HTTPStatus, body: bytes, kind: str, with_body: bool, *, encoding: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        if encoding:
            self.send_header("Content-Encoding", encoding)
        if self._decode_ms is not None:
            self.send_header("Server-Timing", f"decode;dur={self._decode_ms:.1f}")
        self.send_header("Vary", "Accept-Encoding")
        self.send_header("Cache-Control", "no-cache")
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if with_body:
            self.wfile.write(body)
