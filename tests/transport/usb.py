"""A made /sys in which pseudo-terminals are the serial ports of USB adapters."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from busmaster.transport import identity


class UsbTree:
    """What the kernel describes. `root` stands for /sys. `dev`, where it is given, stands for /dev: see `make_node`."""

    def __init__(self, root: Path, dev: Path | None = None) -> None:
        self.root = root
        self.dev = dev
        self._entries: dict[str, tuple[Path, Path]] = {}
        for folder in ("class/tty", "dev/char", "devices"):
            (root / folder).mkdir(parents=True)

    def plug(
        self,
        path: str,
        serial: str = "",
        *,
        place: str = "1-1",
        interface: int = 0,
        number: int | None = None,
        maker: str = "FTDI",
        kind: str = "0403:6001",
        node: str = "",
    ) -> None:
        """Make the device at this path a port of an adapter. `number`: of several ports on one interface.

        `node` is the name that the kernel gives it, that of the device at this path by default.
        """
        vendor, product = kind.split(":")
        adapter = self.root / "devices" / place
        port = adapter / f"{place}:1.{interface}" / f"ttyUSB{number or 0}"
        name = node or path.removeprefix("/dev/")
        tty = port / "tty" / name.replace("/", "!")
        tty.mkdir(parents=True)
        adapter_says = {"idVendor": vendor, "idProduct": product, "manufacturer": maker, "serial": serial}
        for attribute, text in adapter_says.items():
            if text:
                (adapter / attribute).write_text(f"{text}\n")
        (port.parent / "bInterfaceNumber").write_text(f"{interface:02x}\n")
        if number is not None:
            (port / "port_number").write_text(f"{number}\n")
        major, minor = os.major(os.stat(path).st_rdev), os.minor(os.stat(path).st_rdev)
        (tty / "uevent").write_text(f"MAJOR={major}\nMINOR={minor}\nDEVNAME={name}\n")
        (tty / "device").symlink_to(port)
        entries = self.root / "class/tty" / tty.name, self.root / f"dev/char/{major}:{minor}"
        for entry in entries:
            entry.symlink_to(tty)
        self._entries[path] = entries

    def make_node(self, name: str, path: str) -> None:
        """Let the node of this name lead to the device at this path, as the kernel does a moment after it is there."""
        assert self.dev is not None
        (self.dev / name).unlink(missing_ok=True)
        (self.dev / name).symlink_to(path)

    def unplug(self, path: str) -> None:
        for entry in self._entries.pop(path):
            entry.unlink()


@pytest.fixture
def usb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UsbTree:
    """Adapters that are looked for in this tree, with no links to them by name."""
    monkeypatch.setattr(identity, "SYS", tmp_path / "sys")
    monkeypatch.setattr(identity, "LINKS", tmp_path / "links")
    return UsbTree(tmp_path / "sys")


@pytest.fixture
def usb_dev(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UsbTree:
    """Likewise, with a /dev of their own, where nodes come and go."""
    for name, folder in (("SYS", "sys"), ("DEV", "dev"), ("LINKS", "dev/serial")):
        monkeypatch.setattr(identity, name, tmp_path / folder)
    (tmp_path / "dev").mkdir()
    return UsbTree(tmp_path / "sys", tmp_path / "dev")
