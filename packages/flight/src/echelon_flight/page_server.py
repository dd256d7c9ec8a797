"""Web pages for this machine, or for who knows a secret word in their address."""

import abc
import contextlib
import errno
import hmac
import secrets
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar, Final

from echelon_flight import FlightError

_HOST: Final = "127.0.0.1"
_TRIES: Final = 50
_NAMES: Final = (_HOST, "localhost", "[::1]")


class Handler(BaseHTTPRequestHandler, abc.ABC):
    """Answers requests of its own pages on this machine; others get a 403.

    Any website that a person has open can send requests to 127.0.0.1, or let its own name point
    there. So the headers `Host` and `Origin` must both name this server. Pages for other machines
    have a secret word before their paths, which nobody else knows.

    Attributes:
        page: the content of `/`, HTML.
        port: the first that `serving` tries where none is asked for.
        secret: the word before all paths; empty on this machine.
    """

    protocol_version = "HTTP/1.1"
    known = False
    page: bytes = b""
    port: ClassVar[int] = 8642
    secret: ClassVar[str] = ""

    @classmethod
    @contextlib.contextmanager
    def serving(cls, port: int | None = None) -> Iterator[str]:
        """Serve in a thread inside this context, and yield the address.

        Args:
            port: of 127.0.0.1, or the first free one after it.

        Raises:
            FlightError: none of the next 50 is free.
        """
        with _answering(_open(cls, _HOST, cls.port if port is None else port)) as number:
            yield f"http://{_HOST}:{number}/"

    @classmethod
    @contextlib.contextmanager
    def serving_others(cls) -> Iterator[str]:
        """Serve other machines too, and yield the address with its secret word.

        Raises:
            FlightError: no port is free.
        """
        word = secrets.token_urlsafe(9)
        kind = type(cls.__name__, (cls,), {"secret": word})
        with _answering(_open(kind, "", cls.port)) as number:
            yield f"http://{_own_address()}:{number}/{word}/"

    def parse_request(self) -> bool:
        """Read a request; the secret word is no part of its path."""
        good = super().parse_request()
        if good and self.secret:
            first, slash, rest = self.path.removeprefix("/").partition("/")
            known = hmac.compare_digest(first.encode(), self.secret.encode())
            self.known, self.path = known and bool(slash), f"/{rest}"
        return good

    def do_GET(self) -> None:
        """Send the page."""
        if self.allowed() and self.path.split("?")[0] in ("/", "/index.html"):
            self.send(self.page, "text/html; charset=utf-8")
        elif self.allowed():
            self.send(b"not found\n", "text/plain", 404)

    def allowed(self) -> bool:
        """Return whether a request is from this server's pages; refuse it otherwise."""
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        port = self.connection.getsockname()[1]
        hosts = {host} if self.secret else {f"{name}:{port}" for name in _NAMES}
        known = self.known if self.secret else host in hosts
        if known and origin in {None, *(f"http://{x}" for x in hosts)}:
            return True
        if not self.wfile.closed and not getattr(self, "refused", False):
            self.refused = True
            self.send(b"forbidden: not a page of this server\n", "text/plain", 403)
        return False

    def send(self, content: bytes, kind: str, code: int = 200) -> None:
        """Send a complete answer."""
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with contextlib.suppress(ConnectionError):
            self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log no requests."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # Windows would let two servers share a port.
    allow_reuse_address = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a page that was closed while it was sent."""


@contextlib.contextmanager
def _answering(server: _Server) -> Iterator[int]:
    """Let a server answer in a thread inside this context, and yield its port."""
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _own_address() -> str:
    """Return the address by which this machine reaches others; that of itself without a network."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as one:
        # Of UDP: nothing is sent. The address is one of documentation (RFC 5737).
        with contextlib.suppress(OSError):
            one.connect(("192.0.2.1", 9))
            return one.getsockname()[0]
    return _HOST


def _open(handler: type[Handler], host: str, first: int) -> _Server:
    for number in range(first, min(first + _TRIES, 65536)):
        try:
            return _Server((host, number), handler)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise FlightError(f"the page cannot be served: {error.strerror}.") from error
    raise FlightError(f"ports {first} to {first + _TRIES - 1} are in use; give another `--port`.")
