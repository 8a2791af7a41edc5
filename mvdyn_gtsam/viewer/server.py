"""A viser server on the very address that was asked for, or one clear line why not."""

from __future__ import annotations

import contextlib
import errno
import io
import platform
import socket
from collections.abc import Iterator

import viser

from mvdyn_gtsam.errors import ViewerError

LABEL = "mvdyn"


@contextlib.contextmanager
def open_server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """Serve at ``host``:``port`` (0: any free one) until the block ends. Raises ViewerError."""
    # viser takes the next free port in silence, and searches for ever where the host is not ours.
    check_address(host, port)
    with _silence():
        server = viser.ViserServer(host=host, port=port, label=LABEL, verbose=False)
    try:
        # Its button would make the scene public through somebody's server.
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        yield server
    finally:
        with _silence():
            server.stop()


def check_address(host: str, port: int) -> None:
    """Raise ViewerError unless this machine can listen at ``host``:``port``."""
    if not 0 <= port <= 65535:
        raise ViewerError(f"--port {port}: ports are 0 to 65535; 0 takes any free one")
    try:
        for family, kind, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.socket(family, kind) as listener:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind(address)
                listener.listen(1)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ViewerError(
                f"--port {port}: is in use on {host}, perhaps by another viewer; choose another, or 0 for any"
                " free one"
            ) from error
        if error.errno == errno.EACCES:
            raise ViewerError(f"--port {port}: is not allowed to you; choose one above 1023") from error
        raise ViewerError(
            f"--host {host}: is no address of this machine ({error.strerror or error});"
            " 127.0.0.1 serves this machine alone, 0.0.0.0 everybody who reaches it"
        ) from error


def addresses(host: str, port: int) -> list[str]:
    """Lines that say where to look, on this machine and from afar."""
    machine = platform.node() or "THIS_MACHINE"
    if host in ("0.0.0.0", "::"):
        return [f"viewer: http://{machine}:{port} (everybody who reaches this machine can look)"]
    shown = f"[{host}]" if ":" in host else host
    return [
        f"viewer: http://{shown}:{port}",
        f"from another machine: ssh -L {port}:{shown}:{port} {machine}, then open http://127.0.0.1:{port}",
    ]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """viser prints a panel to standard output, which is ours to write."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
