"""The address that was asked for, or one clear line."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("viser", reason="viser, of the view extra, is not installed")

from mvdyn_gtsam.errors import ViewerError
from mvdyn_gtsam.viewer.server import addresses, open_server


def test_a_port_in_use_is_refused_and_not_replaced() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ViewerError, match=f"--port {port}: is in use on 127.0.0.1.*or 0 for any"):
            with open_server("127.0.0.1", port):
                pass


@pytest.mark.parametrize(
    ("host", "port", "message"),
    [
        ("203.0.113.7", 0, "--host 203.0.113.7: is no address of this machine"),
        ("127.0.0.1", 70000, "--port 70000: ports are 0 to 65535"),
        ("127.0.0.1", -1, "--port -1: ports are"),
    ],
)
def test_addresses_that_cannot_be(host: str, port: int, message: str) -> None:
    with pytest.raises(ViewerError, match=message):
        with open_server(host, port):
            pass


def test_the_port_is_free_again_and_nothing_was_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with open_server("127.0.0.1", 0) as server:
        port = server.get_port()
    with open_server("127.0.0.1", port) as server:
        assert server.get_port() == port
    assert capsys.readouterr().out == ""


def test_lines_that_say_where_to_look() -> None:
    here, afar = addresses("127.0.0.1", 8080)
    assert here.endswith("http://127.0.0.1:8080") and "ssh -L 8080:127.0.0.1:8080 " in afar
    assert "ssh -L 8080:[::1]:8080" in addresses("::1", 8080)[1]
    (everybody,) = addresses("0.0.0.0", 80)
    assert "0.0.0.0" not in everybody and ":80 " in everybody
