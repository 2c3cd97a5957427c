"""The socket that the service listens at."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from starcat.errors import ConfigError
from starcat.service.server import listen
from starcat.service.settings import Settings


def test_short_answers_do_not_wait_for_an_acknowledgement(tmp_path: Path) -> None:
    with (
        listen(Settings(root=tmp_path, port=0)) as listening,
        socket.create_connection(listening.getsockname()),
        listening.accept()[0] as accepted,
    ):
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_port_that_is_taken_is_told(tmp_path: Path) -> None:
    with listen(Settings(root=tmp_path, port=0)) as listening:
        port = listening.getsockname()[1]
        with pytest.raises(ConfigError, match=f"cannot listen at 127.0.0.1, port {port}: .*--port"):
            listen(Settings(root=tmp_path, port=port))
