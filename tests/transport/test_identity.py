"""Which device stands behind a name: USB adapters in a made /sys, and real pseudo-terminals."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from busmaster.errors import LineDown
from busmaster.transport import identity
from busmaster.transport.identity import Identity, identify, lasting_name, resolve, usb_devices
from tests.transport.fakes import PtyMaster, closed, opened, plugged, plugged_high, with_the_number_of
from tests.transport.usb import UsbTree

CH340 = "1a86:7523"


@pytest.fixture
def one() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


@pytest.fixture
def two() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


# -- USB adapters ----------------------------------------------------------------------------------------------------


def test_an_adapter_with_a_serial_number_is_known_by_it_wherever_it_is_plugged_in(
    usb: UsbTree, one: PtyMaster, two: PtyMaster
) -> None:
    usb.plug(one.path, "A500ABC", place="1-1.1")
    known = identify(one.path)
    assert str(known) == "FTDI A500ABC"
    usb.unplug(one.path)
    usb.plug(two.path, "A500ABC", place="1-1.2")
    assert known.accepts(identify(two.path))


def test_another_serial_number_interface_or_port_of_an_interface_is_another_device(usb: UsbTree) -> None:
    with plugged() as a, plugged() as b, plugged() as c, plugged() as d:
        usb.plug(a.path, "A500ABC", place="1-1")
        usb.plug(b.path, "A500XYZ", place="1-2")
        usb.plug(c.path, "A500ABC", place="1-1", interface=1)
        usb.plug(d.path, "A500ABC", place="1-1", interface=1, number=1)
        known = [identify(end.path) for end in (a, b, c, d)]
        assert [str(one) for one in known] == [
            "FTDI A500ABC",
            "FTDI A500XYZ",
            "FTDI A500ABC interface 1",
            "FTDI A500ABC interface 1 port 1",
        ]
        assert all(one.accepts(other) is (one is other) for one in known for other in known)


def test_an_adapter_without_a_serial_number_is_known_by_where_it_is_plugged_in(
    usb: UsbTree, one: PtyMaster, two: PtyMaster
) -> None:
    usb.plug(one.path, place="1-1.1", maker="QinHeng", kind=CH340)
    usb.plug(two.path, place="1-1.2", maker="QinHeng", kind=CH340)
    known, other = identify(one.path), identify(two.path)
    assert (str(known), str(other)) == ("QinHeng at USB port 1-1.1", "QinHeng at USB port 1-1.2")
    assert not known.accepts(other)
    usb.unplug(one.path)
    usb.unplug(two.path)
    usb.plug(two.path, place="1-1.1")
    assert not known.accepts(identify(two.path)), "another kind of adapter"
    usb.unplug(two.path)
    usb.plug(one.path, place="1-1.3", maker="QinHeng", kind=CH340)
    assert not known.accepts(identify(one.path)), "elsewhere"


def test_adapters_that_have_all_the_same_serial_number_are_known_by_where_they_are(
    usb: UsbTree, one: PtyMaster, two: PtyMaster
) -> None:
    usb.plug(one.path, "0001", place="1-1")
    alone = identify(one.path)
    usb.plug(two.path, "0001", place="1-2")
    first, second = identify(one.path), identify(two.path)
    assert str(second) == "FTDI 0001 at USB port 1-2"
    assert not alone.accepts(second)
    assert alone.accepts(first)
    usb.unplug(one.path)
    assert not first.accepts(identify(two.path)), "the other is away for the moment"
    assert second.accepts(identify(two.path))


def test_a_port_that_the_kernel_does_not_describe_has_just_gone(usb: UsbTree, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OSError, match="No such device") as caught:
        identify(os.devnull)
    assert caught.value.errno == errno.ENODEV
    monkeypatch.setattr(identity, "SYS", usb.root / "none")
    known = identify(os.devnull)
    assert str(known) == f"{os.devnull} (1:3)"
    assert known.accepts(identify(os.devnull))
    assert not known.accepts(identify("/dev/zero"))
    with open(os.devnull, "rb") as null, open("/dev/zero", "rb") as zero:
        assert known.is_behind(null.fileno())
        assert not known.is_behind(zero.fileno())


def test_the_advice_for_another_device_names_what_this_one_is_found_by(usb: UsbTree) -> None:
    with plugged() as a, plugged() as b, plugged() as c:
        usb.plug(a.path, "A500ABC", place="1-1")
        usb.plug(b.path, "A500ABC", place="1-1", interface=1)
        usb.plug(c.path, place="1-2.3")
        advice = [identify(end.path).advice for end in (a, b, c)]
    assert [text.partition(",")[0] for text in advice] == [
        "name it usb:A500ABC",
        "name it usb:A500ABC:1",
        "plug it in at 1-2.3 again",
    ]


def test_an_adapter_is_called_by_its_product_or_else_by_its_kind(usb: UsbTree, one: PtyMaster) -> None:
    usb.plug(one.path, "A500ABC", maker="", kind=CH340)
    assert str(identify(one.path)) == f"{CH340} A500ABC"
    (usb.root / "devices/1-1/product").write_text("USB Serial\n")
    assert str(identify(one.path)) == "USB Serial A500ABC"


def test_a_port_is_behind_a_name_only_while_the_kernel_describes_it_so(usb: UsbTree, one: PtyMaster) -> None:
    usb.plug(one.path, "A500ABC")
    known = identify(one.path)
    descriptor = os.open(one.path, os.O_RDWR | os.O_NOCTTY)
    assert known.is_behind(descriptor)
    usb.unplug(one.path)
    assert not known.is_behind(descriptor)
    os.close(descriptor)


def test_ttys_are_looked_up_in_the_folder_that_the_kernel_means(
    usb_dev: UsbTree, one: PtyMaster, tmp_path: Path
) -> None:
    (tmp_path / "dev/usb").mkdir()
    usb_dev.plug(one.path, "A500ABC", node="usb/tty0")
    assert identity.all_ttys() == (("usb!tty0", None),)
    usb_dev.make_node("usb/tty0", one.path)
    assert identity.all_ttys() == (("usb!tty0", identity.node_at(one.path)),)
    usb_dev.unplug(one.path)
    assert identity.all_ttys() == ()
    (tmp_path / "sys/class/tty").rmdir()
    assert identity.all_ttys() is None
    assert usb_devices() == []


# -- names by serial number ------------------------------------------------------------------------------------------


def test_a_serial_number_is_resolved_to_the_path_that_its_adapter_has_now(
    usb: UsbTree, one: PtyMaster, two: PtyMaster
) -> None:
    usb.plug(one.path, "A500ABC", place="1-1")
    usb.plug(two.path, "34:85:18:AC", place="1-2", interface=2)
    assert resolve("usb:A500ABC") == resolve("usb:A500ABC:0") == one.path
    assert resolve("usb:34:85:18:AC") == resolve("usb:34:85:18:AC:2") == two.path
    assert resolve("/dev/anything") == "/dev/anything"


def test_a_serial_number_that_is_not_there_says_what_is(usb: UsbTree, one: PtyMaster, two: PtyMaster) -> None:
    with pytest.raises(LineDown, match="usb:A500ABC is not plugged in: no USB serial port was found; plug it in"):
        resolve("usb:A500ABC")
    usb.plug(one.path, "A500XYZ", place="1-1")
    usb.plug(two.path, place="1-2")
    for name in ("usb:A500ABC", "usb:A500XYZ:1", "usb:A500XYZ:x", "usb:A500"):
        with pytest.raises(LineDown, match=f"{name} is not plugged in: connected: ") as caught:
            resolve(name)
        assert f"usb:A500XYZ ({one.path})" in caught.value.what
        assert f"one without a lasting name ({two.path})" in caught.value.what


@pytest.mark.asyncio
async def test_an_attempt_to_open_asks_once_what_is_plugged_in_whether_it_fails_or_not(
    usb: UsbTree, one: PtyMaster, two: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each scan of seven adapters reads fifty files: a port that was gone once took a tenth of a core for that."""
    usb.plug(one.path, "A500ABC", place="1-1")
    usb.plug(two.path, "A500XYZ", place="1-2")
    scans: list[object] = []
    really_list = os.listdir

    def listdir(path: str | Path) -> list[str]:
        scans.extend([path] * (str(path) == str(usb.root / "class/tty")))
        return really_list(path)

    monkeypatch.setattr(os, "listdir", listdir)
    with pytest.raises(LineDown, match=r"usb:A500 is not plugged in: connected: usb:A500.* usb:A500"):
        await opened("usb:A500")
    assert len(scans) == 1
    transport, recorder = await opened("usb:A500ABC")
    assert len(scans) == 2
    await closed(transport, recorder)


def test_a_tty_that_is_no_usb_adapter_is_asked_nothing_but_that(usb: UsbTree, one: PtyMaster) -> None:
    usb.plug(one.path, "A500ABC")
    console, uart = usb.root / "devices/virtual/tty1", usb.root / "devices/platform/serial8250"
    console.mkdir(parents=True)
    (uart / "tty/ttyS0").mkdir(parents=True)
    (uart / "tty/ttyS0/device").symlink_to("../..")
    for tty in (console, uart / "tty/ttyS0"):
        (usb.root / "class/tty" / tty.name).symlink_to(tty)
        (tty / "uevent").mkdir()  # reading it fails, and would drop a USB port
        with pytest.raises(IsADirectoryError):
            (tty / "uevent").read_text()
        assert identity._described(str(tty)) is None
    assert [device.path for device in usb_devices()] == [one.path]


@pytest.mark.parametrize("below", ["", "/ttyUSB0", "/0003:10C4:EA90.0001/ttyX0", "/0003:10C4:EA90.0001/i2c-7/7-004d"])
def test_an_adapter_is_found_however_deep_below_its_interface_the_tty_is(
    usb: UsbTree, one: PtyMaster, below: str
) -> None:
    usb.plug(one.path, "A500ABC", place="1-1.4")
    tty = usb.root / "class/tty" / one.path.removeprefix("/dev/").replace("/", "!")
    device = usb.root / f"devices/1-1.4/1-1.4:1.0{below}"
    device.mkdir(parents=True, exist_ok=True)
    (tty / "device").unlink()
    (tty / "device").symlink_to(device)
    [found] = usb_devices()
    assert (found.path, found.serial, found.interface, found.place) == (one.path, "A500ABC", 0, "1-1.4")


def test_an_adapter_with_several_interfaces_wants_one_of_them_named(
    usb: UsbTree, one: PtyMaster, two: PtyMaster
) -> None:
    usb.plug(one.path, "A500ABC", interface=0)
    usb.plug(two.path, "A500ABC", interface=1)
    with pytest.raises(LineDown, match=r"usb:A500ABC could be any of usb:A500ABC:[01] .*, usb:A500ABC:[01] ") as caught:
        resolve("usb:A500ABC")
    assert f"usb:A500ABC:0 ({one.path})" in caught.value.what
    assert resolve("usb:A500ABC:1") == two.path


def test_the_lasting_name_is_the_serial_number_or_else_the_link_that_udev_keeps(
    usb: UsbTree, one: PtyMaster, two: PtyMaster, tmp_path: Path
) -> None:
    for folder, end in (("by-path", one), ("by-id", two)):
        (tmp_path / "links" / folder).mkdir(parents=True)
        (tmp_path / "links" / folder / "it").symlink_to(end.path)

    def name_of(end: PtyMaster) -> str:
        return lasting_name(next(device for device in usb_devices() if device.path == end.path))

    usb.plug(one.path, place="1-1")
    usb.plug(two.path, "A500ABC", place="1-2", number=0)
    assert (name_of(one), name_of(two)) == (f"{tmp_path}/links/by-path/it", "usb:A500ABC")
    usb.unplug(one.path)
    usb.plug(one.path, "A500ABC", place="1-2", number=1)
    assert name_of(two) == f"{tmp_path}/links/by-id/it"
    assert name_of(one) == ""


def test_of_two_adapters_with_the_same_serial_number_only_the_place_is_a_lasting_name(
    usb: UsbTree, one: PtyMaster, two: PtyMaster, tmp_path: Path
) -> None:
    for folder in ("by-path", "by-id"):
        (tmp_path / "links" / folder).mkdir(parents=True)
    (tmp_path / "links/by-id/it").symlink_to(one.path)  # that of the adapter that was plugged in last
    for end in (one, two):
        (tmp_path / "links/by-path" / os.path.basename(end.path)).symlink_to(end.path)
    usb.plug(one.path, "0001", place="1-1")
    usb.plug(two.path, "0001", place="1-2")
    names = {device.path: lasting_name(device) for device in usb_devices()}
    assert names == {end.path: f"{tmp_path}/links/by-path/{os.path.basename(end.path)}" for end in (one, two)}


def test_the_number_of_an_interface_is_hexadecimal_as_the_kernel_writes_it(usb: UsbTree, one: PtyMaster) -> None:
    usb.plug(one.path, "A500ABC", interface=0x1A)
    assert str(identify(one.path)) == "FTDI A500ABC interface 26"
    assert resolve("usb:A500ABC:26") == one.path


def test_a_text_of_an_adapter_that_is_not_utf_8_hides_no_port(usb: UsbTree, one: PtyMaster, two: PtyMaster) -> None:
    usb.plug(one.path, "A500ABC", place="1-1")
    usb.plug(two.path, "A500XYZ", place="1-2")
    (usb.root / "devices/1-1/manufacturer").write_bytes("Lüttich\n".encode("latin-1"))
    assert str(identify(one.path)) == "L\ufffdttich A500ABC"
    assert {device.path for device in usb_devices()} == {one.path, two.path}


# -- pseudo-terminals ------------------------------------------------------------------------------------------------


def test_a_pseudo_terminal_stays_the_same_whatever_is_done_to_it(one: PtyMaster, two: PtyMaster) -> None:
    known = identify(one.path)
    descriptor = os.open(one.path, os.O_RDWR | os.O_NOCTTY)
    os.write(descriptor, b"x")
    os.chmod(one.path, 0o666)
    os.chown(one.path, os.getuid(), os.getgid())
    assert known.is_behind(descriptor)
    os.close(descriptor)
    assert known.accepts(identify(one.path))
    assert not known.accepts(identify(two.path))


def test_what_a_pseudo_terminal_is_known_by_is_given_back(one: PtyMaster) -> None:
    def kept() -> int:
        found = 0
        for number in os.listdir("/proc/self/fd"):
            with contextlib.suppress(FileNotFoundError):
                found += os.readlink(f"/proc/self/fd/{number}") == one.path
        return found

    known = identify(one.path)
    assert kept() == 1
    del known
    assert kept() == 0


def with_reused_number(check: Callable[[Identity, PtyMaster], None], link: Path | None = None) -> None:
    """Check what was known of a pseudo-terminal against another one that got its number."""
    with plugged_high() as end:
        if link is not None:
            link.symlink_to(end.path)
        known = identify(end.path if link is None else str(link))
        end.unplug()
        with with_the_number_of(end) as heir:
            check(known, heir)


def test_the_number_of_a_pseudo_terminal_does_not_make_it_the_same() -> None:
    def check(known: Identity, heir: PtyMaster) -> None:
        other = identify(heir.path)
        assert not known.accepts(other)
        assert str(known).startswith("the pseudo-terminal made at 20")

    with_reused_number(check)


def test_a_link_left_behind_is_not_followed_to_a_number_reused_but_one_made_anew_is(tmp_path: Path) -> None:
    link = tmp_path / "line"

    def check(known: Identity, heir: PtyMaster) -> None:
        assert not known.accepts(identify(str(link)))
        link.unlink()
        link.symlink_to(heir.path)
        assert known.accepts(identify(str(link)))
        assert not known.accepts(identify(heir.path)), "by its own path"

    with_reused_number(check, link)


def test_a_link_to_a_link_is_followed_when_either_is_made_anew(tmp_path: Path, one: PtyMaster, two: PtyMaster) -> None:
    (tmp_path / "outer").symlink_to("inner")
    (tmp_path / "inner").symlink_to(one.path)
    known = identify(str(tmp_path / "outer"))
    (tmp_path / "inner").unlink()
    (tmp_path / "inner").symlink_to(two.path)
    assert known.accepts(identify(str(tmp_path / "outer")))


def test_devices_of_different_kinds_are_never_the_same(usb: UsbTree, one: PtyMaster, two: PtyMaster) -> None:
    usb.plug(one.path, "A500ABC")
    (usb.root / "dev/char/1:3").touch()
    known = [identify(path) for path in (one.path, two.path, os.devnull)]
    assert all(one.accepts(other) is (one is other) for one in known for other in known)
    assert all(one.advice for one in known)
