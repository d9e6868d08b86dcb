"""Whose line a PORT is, whatever it is called."""

from __future__ import annotations

import os
import pty
from pathlib import Path

import pytest

from busmaster.app.cli import reaching
from busmaster.app.service.folder import Owner
from busmaster.transport.endpoints import endpoint
from tests.transport.usb import UsbTree


@pytest.fixture
def owned(monkeypatch: pytest.MonkeyPatch) -> list[Owner]:
    """The owners that there are."""
    owners: list[Owner] = []
    monkeypatch.setattr(reaching, "owners", lambda: iter(owners))
    return owners


def owner_of(port: str) -> str | None:
    found = reaching.owner_of(endpoint(port))
    return None if found is None else found.name


def test_a_device_is_known_by_its_links(tmp_path: Path, owned: list[Owner]) -> None:
    device, link = tmp_path / "ttyUSB0", tmp_path / "slitter"
    device.touch()
    link.symlink_to(device)
    owned.append(Owner("line", str(device), "/run/line.sock", 1))
    assert owner_of(f"{link}?baudrate=9600") == owner_of(f"{device}?baudrate=9600") == "line"
    assert owner_of(f"{tmp_path}/ttyUSB1?baudrate=9600") is None
    owned[:] = [Owner("line", str(link), "/run/line.sock", 1)]
    assert owner_of(f"{device}?baudrate=9600") == "line"


def test_a_host_is_known_by_its_addresses_and_its_port(owned: list[Owner]) -> None:
    owned.append(Owner("line", "127.0.0.1:4001", "/run/line.sock", 1))
    assert owner_of("socket://localhost:4001") == owner_of("socket://127.0.0.1:4001") == "line"
    assert owner_of("socket://localhost:4002") is None
    for spelling in ("[::ffff:127.0.0.1]", "[::ffff:7f00:1]", "0.0.0.0", "[::1]", "[0:0:0:0:0:0:0:1]", "127.1"):
        assert owner_of(f"socket://{spelling}:4001") == "line", spelling
        assert owner_of(f"socket://{spelling}:4002") is None
    owned[:] = [Owner("line", "[::ffff:192.0.2.7]:4001", "/run/line.sock", 1)]
    assert owner_of("socket://192.0.2.7:4001") == owner_of("socket://[::ffff:c000:207]:4001") == "line"
    assert owner_of("socket://192.0.2.8:4001") is None


def test_an_adapter_is_known_by_its_serial_number_and_by_its_device(usb: UsbTree, owned: list[Owner]) -> None:
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    usb.plug(path, "A500ABC")
    owned.append(Owner("line", "usb:A500ABC", "/run/line.sock", 1))
    assert owner_of(f"{path}?baudrate=9600") == owner_of("usb:A500ABC?baudrate=9600") == "line"
    owned[:] = [Owner("line", path, "/run/line.sock", 1)]
    assert owner_of("usb:A500ABC?baudrate=9600") == "line"
    usb.unplug(path)
    assert owner_of("usb:A500ABC?baudrate=9600") is None
    owned[:] = [Owner("line", "usb:A500ABC", "/run/line.sock", 1)]
    assert owner_of("usb:A500ABC?baudrate=9600") == "line"
    os.close(master)
    os.close(slave)
