"""A real mosquitto, on a port of its own."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.app.outputs.cycles import until
from tests.patience import PATIENCE
from tests.ports import free_port

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")

needs_mosquitto = pytest.mark.skipif(
    MOSQUITTO is None or find_spec("aiomqtt") is None,
    reason="needs mosquitto (apt-get install mosquitto) and aiomqtt (the extra named mqtt)",
)


class Broker:
    """Can be stopped and started again on its port: what it has promised to keep, it keeps."""

    def __init__(self, folder: Path, certificate: Path | None = None) -> None:
        """`certificate`: a file with a certificate and its key, with which the connection is encrypted."""
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        encrypted = f"certfile {certificate}\nkeyfile {certificate}\n" if certificate is not None else ""
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\nmax_queued_messages 0\n"
            f"persistence_location {folder}/\nuser root\n{encrypted}"
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        assert MOSQUITTO is not None
        self._process = subprocess.Popen([MOSQUITTO, "-c", str(self._config)], stderr=subprocess.DEVNULL)
        until(self._answers)

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(PATIENCE)
            self._process = None

    def forget(self) -> None:
        """Lose all messages, while it is stopped."""
        (self._config.parent / "mosquitto.db").unlink(missing_ok=True)

    def _answers(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), PATIENCE).close()
        except OSError:
            return False
        return True


@contextmanager
def running(folder: Path, certificate: Path | None = None) -> Iterator[Broker]:
    broker = Broker(folder, certificate)
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()
