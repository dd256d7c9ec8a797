"""Web pages for this machine only."""

import abc
import contextlib
import errno
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
    there. So the headers `Host` and `Origin` must both name this server.

    Attributes:
        page: the content of `/`, HTML.
        port: the first that `serving` tries where none is asked for.
    """

    protocol_version = "HTTP/1.1"
    page: bytes = b""
    port: ClassVar[int] = 8642

    @classmethod
    @contextlib.contextmanager
    def serving(cls, port: int | None = None) -> Iterator[str]:
        """Serve in a thread inside this context, and yield the address.

        Args:
            port: of 127.0.0.1, or the first free one after it.

        Raises:
            FlightError: none of the next 50 is free.
        """
        server = _open(cls, cls.port if port is None else port)
        thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
        thread.start()
        try:
            yield f"http://{_HOST}:{server.server_address[1]}/"
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

    def do_GET(self) -> None:
        """Send the page."""
        if self.allowed() and self.path.split("?")[0] in ("/", "/index.html"):
            self.send(self.page, "text/html; charset=utf-8")
        elif self.allowed():
            self.send(b"not found\n", "text/plain", 404)

    def allowed(self) -> bool:
        """Return whether a request is from this server's pages; refuse it otherwise."""
        port = self.connection.getsockname()[1]
        hosts = {f"{name}:{port}" for name in _NAMES}
        origin = self.headers.get("Origin")
        if self.headers.get("Host") in hosts and origin in {None, *(f"http://{x}" for x in hosts)}:
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


def _open(handler: type[Handler], first: int) -> _Server:
    for number in range(first, min(first + _TRIES, 65536)):
        try:
            return _Server((_HOST, number), handler)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise FlightError(f"the page cannot be served: {error.strerror}.") from error
    raise FlightError(f"ports {first} to {first + _TRIES - 1} are in use; give another `--port`.")
