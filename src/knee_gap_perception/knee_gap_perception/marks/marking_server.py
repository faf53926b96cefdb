"""The page on which pictures are marked, served to this machine alone."""

import json
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

from knee_gap_core.user_files import json_value
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.marking_session import MarkingSession

LOOPBACK = "127.0.0.1"
MOST_BYTES = 4 << 20
PAGE = Path(__file__).with_name("marking_page.html")
JSON, HTML, PNG = "application/json", "text/html; charset=utf-8", "image/png"


class MarkingServer(ThreadingHTTPServer):
    """Serves one session on the loopback; port 0 takes any that is free. Raises OSError if it is taken."""

    daemon_threads = True

    def __init__(self, session: MarkingSession, port: int) -> None:
        self.session = session
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{LOOPBACK}:{self.server_port}/"

    def own_names(self) -> set[str]:
        """Names by which a page of this server may call it: a foreign page must not write marks."""
        return {f"{host}:{self.server_port}" for host in (LOOPBACK, "localhost")}


class _Handler(BaseHTTPRequestHandler):
    """GET /: the page; /state: pictures and marks; /picture/N: one picture. PUT /picture/N: its marks."""

    server: MarkingServer
    timeout = 30.0

    def do_GET(self) -> None:
        """Answer with the page, the state or a picture."""
        self._guarded(self._get)

    def do_PUT(self) -> None:
        """Keep the marks of a picture."""
        self._guarded(self._put)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing: a line for each picture would hide the messages."""

    def _guarded(self, answer: object) -> None:
        origin = self.headers.get("Origin")
        allowed = self.server.own_names()
        if self.headers.get("Host") not in allowed or (origin and urlsplit(origin).netloc not in allowed):
            self._send(HTTPStatus.FORBIDDEN, JSON, _error("only this machine may ask"))
            return
        try:
            assert callable(answer)
            answer()
        except (PerceptionError, OSError) as error:
            self._send(HTTPStatus.BAD_REQUEST, JSON, _error(str(error)))

    def _get(self) -> None:
        path = urlsplit(self.path).path
        if path == "/":
            self._send(HTTPStatus.OK, HTML, PAGE.read_bytes())
        elif path == "/state":
            self._send(HTTPStatus.OK, JSON, json.dumps(self.server.session.state()).encode())
        elif (index := _index(path)) is not None:
            self._send(HTTPStatus.OK, PNG, self.server.session.png(index))
        else:
            self._send(HTTPStatus.NOT_FOUND, JSON, _error("there is no such page"))

    def _put(self) -> None:
        index = _index(urlsplit(self.path).path)
        if index is None:
            self._send(HTTPStatus.NOT_FOUND, JSON, _error("there is no such page"))
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            raise PerceptionError(f"the marks must have a length of at most {MOST_BYTES} bytes")
        try:
            entry = json_value(self.rfile.read(int(length)).decode())
        except ValueError as error:
            raise PerceptionError(f"the marks are not JSON: {error}") from None
        self.server.session.save(index, entry)
        self._send(HTTPStatus.OK, JSON, b"{}")

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)


def _index(path: str) -> int | None:
    """N of /picture/N."""
    start, _, number = path.rpartition("/")
    return int(number) if start == "/picture" and number.isdecimal() and len(number) < 9 else None


def _error(text: str) -> bytes:
    return json.dumps({"error": text}).encode()
