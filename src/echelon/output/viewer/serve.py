"""A page served to this machine alone, and the browser that shows it."""

import abc
import contextlib
import errno
import threading
import webbrowser
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from echelon.core.errors import OutputError

HOST: Final = "127.0.0.1"
PORT: Final = 8642
_TRIES: Final = 50
_NAMES: Final = (HOST, "localhost", "[::1]")


class Handler(BaseHTTPRequestHandler, abc.ABC):
    """Answers requests for `page` that come from this machine's own pages; others get a 403.

    Any page that a person has open can send requests to 127.0.0.1, and a name of another's may be
    made to mean it. So both headers that tell of that must be ours.
    """

    protocol_version = "HTTP/1.1"
    page: bytes = b""

    def do_GET(self) -> None:
        """Send the page."""
        if self.allowed() and self.path.split("?")[0] in ("/", "/index.html"):
            self.send(self.page, "text/html; charset=utf-8")
        elif self.allowed():
            self.send(b"there is nothing here.\n", "text/plain", 404)

    def allowed(self) -> bool:
        """Tell whether a request is ours, and refuse it where it is not."""
        port = self.connection.getsockname()[1]
        ours = {f"{name}:{port}" for name in _NAMES}
        origin = self.headers.get("Origin")
        if self.headers.get("Host") in ours and origin in {None, *(f"http://{x}" for x in ours)}:
            return True
        if not self.wfile.closed and not getattr(self, "refused", False):
            self.refused = True
            self.send(b"only pages of this server may ask.\n", "text/plain", 403)
        return False

    def send(self, content: bytes, kind: str, code: int = 200) -> None:
        """Send a whole answer."""
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with contextlib.suppress(ConnectionError):
            self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of requests."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # Windows would let two servers share a port.
    allow_reuse_address = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a page that was closed while it was being sent."""


def serve(handler: type[BaseHTTPRequestHandler], port: int | None = None) -> ThreadingHTTPServer:
    """Return a server on 127.0.0.1, on the asked port or the first free one after it.

    Raises:
        OutputError: none of the next 50 is free.
    """
    first = PORT if port is None else port
    if not 0 <= first <= 65535:
        raise OutputError(f"`--port` is {first}, and must be from 0 to 65535.")
    for number in range(first, min(first + _TRIES, 65536)):
        try:
            return _Server((HOST, number), handler)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise OutputError(f"no page can be served: {error.strerror}.") from error
    raise OutputError(f"all ports from {first} to {first + _TRIES - 1} are in use; name another.")


@contextlib.contextmanager
def serving(server: ThreadingHTTPServer) -> Iterator[str]:
    """Serve in a thread as long as this lasts, and yield the address."""
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def open_browser(address: str) -> bool:
    """Open an address in the person's browser, and tell whether there is one."""
    try:
        return webbrowser.open(address)
    except webbrowser.Error:
        return False
