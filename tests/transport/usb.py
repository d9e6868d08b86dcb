"""A made /sys in which pseudo-terminals are the serial ports of USB adapters."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from busmaster.transport import identity


class UsbTree:
    """What the kernel describes. `root` stands for /sys."""

    def __init__(self, root: Path) -> None:
        self.root = root
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
    ) -> None:
        """Make the device at this path a port of an adapter. `number`: of several ports on one interface."""
        vendor, product = kind.split(":")
        adapter = self.root / "devices" / place
        port = adapter / f"{place}:1.{interface}" / f"ttyUSB{number or 0}"
        name = path.removeprefix("/dev/")
        tty = port / "tty" / name.replace("/", "!")
        tty.mkdir(parents=True)
        adapter_says = {"idVendor": vendor, "idProduct": product, "manufacturer": maker, "serial": serial}
        for attribute, text in adapter_says.items():
            if text:
                (adapter / attribute).write_text(f"{text}\n")
        (port.parent / "bInterfaceNumber").write_text(f"{interface:02x}\n")
        if number is not None:
            (port / "port_number").write_text(f"{number}\n")
        node = os.stat(path).st_rdev
        (tty / "uevent").write_text(f"MAJOR={os.major(node)}\nMINOR={os.minor(node)}\nDEVNAME={name}\n")
        (tty / "device").symlink_to(port)
        entries = self.root / "class/tty" / tty.name, self.root / f"dev/char/{os.major(node)}:{os.minor(node)}"
        for entry in entries:
            entry.symlink_to(tty)
        self._entries[path] = entries

    def unplug(self, path: str) -> None:
        for entry in self._entries.pop(path):
            entry.unlink()


@pytest.fixture
def usb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UsbTree:
    """Adapters that are looked for in this tree, with no links to them by name."""
    monkeypatch.setattr(identity, "SYS", tmp_path / "sys")
    monkeypatch.setattr(identity, "LINKS", tmp_path / "links")
    return UsbTree(tmp_path / "sys")
