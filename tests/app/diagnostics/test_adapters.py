"""What can be said of a port without opening it, on made-up /proc and /sys trees and on real ptys."""

from __future__ import annotations

import asyncio
import fcntl
import grp
import os
import stat
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.diagnostics.adapters import (
    Finding,
    inspect,
    latency_timer,
    low_latency,
    made_rate,
    opened_latency,
    rs485_mode,
)
from busmaster.app.diagnostics.examination import Patient, driver, opening, rate, remote_port
from busmaster.transport import identity
from busmaster.transport.holders import Holder, holders, how_to_open, lock_owner, owning_group
from busmaster.transport.rfc2217 import ModemLines, Rfc2217Port
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort
from tests.transport.fakes import PtyMaster, plugged
from tests.transport.usb import UsbTree


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


@pytest.fixture
def sysfs(tmp_path: Path, pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A /sys in which the pty is an FTDI adapter with its timer at 16 ms."""
    device = tmp_path / "sys/class/tty" / os.path.basename(pty_master.path) / "device"
    device.mkdir(parents=True)
    (device / "latency_timer").write_text("16\n")
    (tmp_path / "drivers/ftdi_sio").mkdir(parents=True)
    (device / "driver").symlink_to(tmp_path / "drivers/ftdi_sio")
    monkeypatch.setattr(identity, "SYS", tmp_path / "sys")
    return tmp_path / "sys"


@pytest.fixture
def process(pty_master: PtyMaster) -> Iterator[int]:
    """The id of another process that has the port open and locked."""
    hold = f"import fcntl; f = open({pty_master.path!r}); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-ISc", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        yield other.pid
        other.communicate(b"\n")


def topics(found: tuple[Finding, ...]) -> dict[str, bool]:
    return {finding.topic: finding.ok for finding in found}


def test_a_port_in_order_has_nothing_against_it(pty_master: PtyMaster) -> None:
    assert topics(inspect(pty_master.path)) == {"port": True, "permission": True, "holders": True}


def test_every_fault_comes_with_what_to_do(tmp_path: Path, pty_master: PtyMaster, sysfs: Path, process: int) -> None:
    found = inspect(pty_master.path)
    assert topics(found) == {"port": True, "permission": True, "holders": False, "driver": True, "latency": False}
    assert all(finding.advice for finding in found if not finding.ok)
    text = "\n".join(finding.what for finding in found)
    assert f"(process {process})" in text
    assert "ftdi_sio" in text
    assert "up to 16 ms" in text


def test_a_quick_adapter_is_in_order(pty_master: PtyMaster, sysfs: Path) -> None:
    timer = sysfs / "class/tty" / os.path.basename(pty_master.path) / "device/latency_timer"
    timer.write_text("1\n")
    assert latency_timer(pty_master.path) == 1
    assert topics(inspect(pty_master.path))["latency"]
    timer.unlink()
    assert latency_timer(pty_master.path) is None


def test_a_latency_timer_of_more_than_2_ms_comes_with_the_ways_to_shorten_it(
    pty_master: PtyMaster, sysfs: Path
) -> None:
    timer = sysfs / "class/tty" / os.path.basename(pty_master.path) / "device/latency_timer"
    timer.write_text("2\n")
    assert topics(inspect(pty_master.path))["latency"]
    timer.write_text("3\n")
    [found] = [finding for finding in inspect(pty_master.path) if finding.topic == "latency"]
    by_root = f"write 1 to {timer} as root"
    assert (found.ok, found.what) == (False, "the adapter gathers received bytes for up to 3 ms (latency_timer)")
    assert found.advice == f"add ?low_latency=1 to the port (low_latency=True in Python), or {by_root}"
    assert "latency" in topics(inspect(pty_master.path, low_latency=False))
    assert "latency" not in topics(inspect(pty_master.path, low_latency=True)), "its timer is set as it is opened"
    [opened] = opened_latency(pty_master.path)
    assert opened.advice == f"low_latency=1 did not shorten it; {by_root}"
    timer.write_text("odd\n")
    assert list(opened_latency(pty_master.path)) == []


def test_a_port_must_be_readable_and_writable(pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    for allowed, ok in ((os.R_OK, False), (os.W_OK, False), (os.R_OK | os.W_OK, True)):
        monkeypatch.setattr(os, "access", lambda _, mode, allowed=allowed: mode & ~allowed == 0)
        assert topics(inspect(pty_master.path))["permission"] is ok


def test_an_adapter_that_is_named_by_a_link_is_examined_as_what_it_points_to(tmp_path: Path, sysfs: Path) -> None:
    """As one is of /dev/serial/by-id."""
    [entry] = os.listdir(sysfs / "class/tty")
    link = tmp_path / "usb-FTDI_A5069RR4-if00-port0"
    link.symlink_to(f"/dev/pts/{entry}")
    found = inspect(str(link))
    assert not topics(found)["latency"]
    assert "ftdi_sio" in "\n".join(finding.what for finding in found)
    assert latency_timer(str(link)) == 16


def test_what_is_no_port_is_said_first_and_alone(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("/dev/pts/99999")
    (tmp_path / "null").symlink_to("/dev/null")
    for name, says, advice in (
        ("file", "is not a device", "give the path of a serial port"),
        ("link", "points to /dev/pts/99999, which is gone", "plug it in again"),
        ("none", "does not exist", "see `python -m serial.tools.list_ports`"),
        ("null", "is not a serial port", "see `python -m serial.tools.list_ports`"),
    ):
        (finding,) = inspect(str(tmp_path / name))
        assert not finding.ok
        assert says in finding.what
        assert finding.advice == advice


def test_a_port_that_may_not_be_opened_names_its_group(pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    permission = inspect(pty_master.path)[1]
    assert not permission.ok
    assert f"it belongs to the group {owning_group(pty_master.path)}" in permission.what
    assert permission.advice == how_to_open(pty_master.path)


@pytest.mark.parametrize(
    ("group", "mode", "joins"), [(20, 0o660, True), (20, 0o640, False), (20, 0o600, False), (0, 0o660, False)]
)
def test_only_a_group_that_opens_the_port_and_is_not_roots_is_to_be_joined(
    group: int, mode: int, joins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = os.stat_result((stat.S_IFCHR | mode, 0, 0, 1, 0, group, 0, 0, 0, 0))
    monkeypatch.setattr(os, "stat", lambda *_: said)
    advice = how_to_open("/dev/ttyS0")
    assert ("sudo usermod -aG" in advice) is joins
    assert ('MODE="0660"' in advice) is not joins


def test_a_group_without_a_name_goes_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def nameless(gid: int) -> None:
        raise KeyError(gid)

    status = os.stat_result((stat.S_IFCHR | 0o660, 0, 0, 1, 4711, 4712, 0, 0, 0, 0))  # owner 4711, group 4712
    with monkeypatch.context() as patch:
        patch.setattr(os, "stat", lambda *_: status)
        patch.setattr(grp, "getgrgid", nameless)
        group = owning_group("/dev/ttyS0")
    assert group == "4712"


def test_who_holds_and_who_locks_a_port_is_found_through_its_link(tmp_path: Path, pty_master: PtyMaster) -> None:
    link = tmp_path / "port"
    link.symlink_to(pty_master.path)
    assert holders(str(link)) == ()
    assert lock_owner(str(link)) is None
    with open(pty_master.path, "rb", buffering=0) as port:
        fcntl.flock(port, fcntl.LOCK_EX)
        (holder,) = holders(str(link))
        assert str(holder) == "this program"
        assert lock_owner(str(link)) == holder


@pytest.mark.parametrize(
    ("command", "line", "name"),
    [
        ("gpsd", "gpsd -N /dev/ttyUSB0", "gpsd"),
        ("python3", "/usr/bin/python3 -m busmaster run line.toml --token x", "python3 -m busmaster run"),
        ("python3.11", "python -I poll.py --password x", "python3.11 -I poll.py"),
        ("python", "python -u -c import@sys;print(1)", "python -u -c"),
        ("python", "python -m timeit", "python -m timeit"),
        ("python", "python -Im busmaster safe line.toml", "python -Im busmaster safe"),
        ("python", "python -W error -X dev -m busmaster run x", "python -W error -X dev -m busmaster run"),
        ("python", "python -Xtracemalloc -Im busmaster run x", "python -Xtracemalloc -Im busmaster run"),
        ("python", "python -Xpycache_prefix=/tmp/m poll.py secret", "python -Xpycache_prefix=/tmp/m poll.py"),
        ("python", "python -mbusmaster run secret", "python -mbusmaster run"),
        ("python", "python -Iclogin('secret') more", "python -Ic"),
        ("python", "python --check-hash-based-pycs always x.py y", "python --check-hash-based-pycs always x.py"),
        ("python", "python --version secret.py", "python --version secret.py"),
        ("python", "python - secret", "python -"),
        ("python", "python", "python"),
        ("python", "python /a\nb.py", "python /a\\nb.py"),
        ("python", "", "python"),
    ],
)
def test_of_a_program_in_python_the_module_or_script_is_named_and_no_more(
    tmp_path: Path, pty_master: PtyMaster, command: str, line: str, name: str
) -> None:
    process = tmp_path / "4711"
    (process / "fd").mkdir(parents=True)
    (process / "fdinfo").mkdir()
    (process / "fd/3").symlink_to(pty_master.path)
    (process / "fdinfo/3").write_text("flags:\t0100002\n")
    (process / "comm").write_text(f"{command}\n")
    (process / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in line.split(" ") if word))
    assert holders(pty_master.path, proc=tmp_path) == (Holder(4711, name),)


def test_a_process_that_only_names_the_port_does_not_hold_it(tmp_path: Path, pty_master: PtyMaster) -> None:
    for number, (pid, flags) in enumerate((("4711", "0100002"), ("812", "012100002"), ("9", "0100002")), 3):
        (tmp_path / pid / "fd").mkdir(parents=True)
        (tmp_path / pid / "fdinfo").mkdir()
        for name, target in (("0", "/dev/null"), (str(number), pty_master.path)):
            (tmp_path / pid / "fd" / name).symlink_to(target)
            (tmp_path / pid / "fdinfo" / name).write_text(f"pos:\t0\nflags:\t{flags}\nmnt_id:\t26\n")
    assert [holder.pid for holder in holders(pty_master.path, proc=tmp_path)] == [9, 4711]


def test_whoever_emulates_the_line_on_a_pty_is_no_second_master(pty_master: PtyMaster) -> None:
    """An emulator has the port open too, so that clients may come and go."""
    with open(pty_master.path, "rb", buffering=0):
        assert holders(pty_master.path)
        assert topics(inspect(pty_master.path))["holders"]


def test_a_process_that_cannot_be_seen_into_is_another_program(tmp_path: Path, pty_master: PtyMaster) -> None:
    inode = os.stat(pty_master.path)
    place = f"{os.major(inode.st_dev):02x}:{os.minor(inode.st_dev):02x}:{inode.st_ino}"
    in_another_container = (0, -1)
    for pid, owner in ((4711, Holder(4711, "another program")), *((number, None) for number in in_another_container)):
        (tmp_path / "locks").write_text(
            f"1: POSIX ADVISORY WRITE 1 {place} 0 EOF\n2: FLOCK ADVISORY WRITE {pid} {place} 0 EOF\n"
        )
        assert lock_owner(pty_master.path, proc=tmp_path) == owner
    assert str(Holder(4711, "another program")) == "another program (process 4711)"


def test_a_system_without_these_trees_knows_nothing(tmp_path: Path, pty_master: PtyMaster) -> None:
    assert lock_owner(pty_master.path, proc=tmp_path / "proc") is None
    assert lock_owner(str(tmp_path / "gone")) is None
    assert holders(pty_master.path, proc=tmp_path / "proc") == ()


def test_a_pty_has_no_rs485_mode_and_a_driver_tells_its_own(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert rs485_mode(pty_master.fd) is None
    for flags in (0, 1, 2 | 4):
        monkeypatch.setattr(fcntl, "ioctl", lambda _, __, settings, flags=flags: settings.__setitem__(0, flags))
        assert rs485_mode(pty_master.fd) is bool(flags & 1)


def test_a_pty_has_no_low_latency_flag_and_a_driver_tells_its_own(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert low_latency(pty_master.fd) is None
    for flag in (0, 1 << 13):
        monkeypatch.setattr(fcntl, "ioctl", lambda _, __, settings, flag=flag: settings.__setitem__(4, flag))
        assert low_latency(pty_master.fd) is bool(flag)


def test_the_low_latency_flag_is_told_with_how_to_set_it(
    monkeypatch: pytest.MonkeyPatch, pty_master: PtyMaster
) -> None:
    def told(flags: int | None, wanted: bool | None = None) -> tuple[str, str]:
        def ioctl(_descriptor: int, request: int, settings: Any) -> int:
            if flags is None or request != termios.TIOCGSERIAL:
                raise OSError("no such flag")
            settings[4] = flags
            return 0

        monkeypatch.setattr(fcntl, "ioctl", ioctl)
        [finding] = [finding for finding in driver(pty_master.fd, wanted) if finding.topic == "driver"]
        assert finding.ok
        return finding.what, finding.advice

    assert told(1 << 13) == ("its low-latency flag is set", "")
    assert told(0) == ("its low-latency flag is not set", "?low_latency=1 may bring replies sooner")
    assert told(None) == ("it has no low-latency flag", "")
    assert told(1 << 13, wanted=True) == ("its low-latency flag is set", "")
    assert told(0, wanted=True) == ("its low-latency flag is not set, although low_latency=1 was given", "")
    assert told(0, wanted=False) == ("its low-latency flag is not set", "")


def test_a_rate_that_a_uart_cannot_make_is_told_where_its_driver_tells_what_it_divides(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert made_rate(pty_master.fd, 57600) is None
    assert list(rate(pty_master.fd, 57600)) == []
    monkeypatch.setattr(fcntl, "ioctl", lambda _, __, settings: settings.__setitem__(7, 115200))
    assert list(rate(pty_master.fd, 38400)) == []
    [finding] = rate(pty_master.fd, 76800)
    assert not finding.ok
    assert finding.what == "its UART makes 57600 baud of 76800, -25.0%"
    [finding] = rate(pty_master.fd, 921600)
    assert finding.what == "its UART makes 115200 baud of 921600, -87.5%"
    for base, differs in ((10_190, False), (10_210, True), (9_810, False), (9_790, True), (0, False)):
        monkeypatch.setattr(fcntl, "ioctl", lambda _, __, settings, base=base: settings.__setitem__(7, base))
        assert bool(list(rate(pty_master.fd, 10_000))) is differs


def test_the_rs485_mode_of_a_driver_is_reported_unless_software_switches(
    monkeypatch: pytest.MonkeyPatch, pty_master: PtyMaster
) -> None:
    def found(mode: int | None, *, switched: bool = False) -> Finding:
        def ioctl(_descriptor: int, request: int, settings: Any) -> int:
            if mode is None or request == termios.TIOCGSERIAL:
                raise OSError("no such mode")
            settings[0] = mode
            return 0

        monkeypatch.setattr(fcntl, "ioctl", ioctl)
        [finding] = [finding for finding in driver(pty_master.fd, switched=switched) if finding.topic == "rs485"]
        assert finding.ok
        return finding

    assert found(None).what.startswith("the driver has no RS-485 mode: the adapter switches by itself")
    assert found(1) == Finding("rs485", True, "the driver switches the transmitter (RS-485 mode)")
    assert found(0).what == "the driver's RS-485 mode is off"
    assert "add ?rs485=1 (rs485=True in Python), or ?rs485.by=software" in found(0).advice
    for mode in (None, 0, 1):
        assert found(mode, switched=True) == Finding("rs485", True, "software switches the transmitter by RTS")


class Remote(asyncio.Transport):
    """A connection to an RFC 2217 server that reports these errors and lines."""

    def __init__(self, errors: object, lines: ModemLines | None) -> None:
        super().__init__({"line_errors": lambda: errors, "modem_lines": lines})


def test_what_an_rfc_2217_server_reports_of_its_port_is_shown() -> None:
    errors, lines = remote_port(Remote(object(), ModemLines(cts=True, dsr=False, ri=False, cd=True)))
    assert errors == Finding("line errors", True, "the server reports line errors")
    assert lines == Finding("modem lines", True, "the server reports CTS on, DSR off, RI off, CD on")
    patient = Patient(Rfc2217Port("server", 4001, baudrate=19200), "msc")
    opened = Finding("open", True, "it opens at 19200 8N1", "MSC nodes support only 9600 baud, not 19200")
    wire: Any = SimpleNamespace(transport=Remote(None, ModemLines(cts=True, dsr=False, ri=False, cd=True)))
    assert list(opening(patient, wire)) == [opened, *remote_port(wire.transport)]
    [errors] = remote_port(Remote(None, None))
    assert (errors.ok, errors.what) == (True, "the server has not confirmed that it reports line errors")
    assert errors.advice.startswith("parity and framing errors are not counted: each shows as a garbled reply")


def test_a_rate_behind_a_raw_tcp_port_that_no_device_has_is_noted_too() -> None:
    wire: Any = SimpleNamespace(transport=object())
    [found] = opening(Patient(TcpPort("server", 4001, baudrate=19200), "msc"), wire)
    assert found == Finding("open", True, "it opens", "MSC nodes support only 9600 baud, not 19200")
    for patient in (Patient(TcpPort("server", 4001, baudrate=19200)), Patient(TcpPort("server", 4001), "msc")):
        assert list(opening(patient, wire)) == [Finding("open", True, "it opens")]


def test_an_open_serial_port_is_reported_with_its_rate_and_its_driver(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    device: Any = SimpleNamespace(fileno=lambda: pty_master.fd)
    wire: Any = SimpleNamespace(transport=SimpleNamespace(get_extra_info={"serial": device}.get))
    port = SerialPort("/dev/ttyS0", baudrate=76800, low_latency=True, rs485=Rs485(by="software"))

    def ioctl(_descriptor: int, request: int, settings: Any) -> int:
        if request == termios.TIOCGSERIAL:
            settings[7] = 115200
            return 0
        raise OSError("no such mode")

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    found = list(opening(Patient(port), wire))
    assert [(one.topic, one.ok) for one in found] == [
        ("open", True),
        ("rate", False),
        ("driver", True),
        ("rs485", True),
    ]
    assert found[1].what == "its UART makes 57600 baud of 76800, -25.0%"
    assert found[2].what == "its low-latency flag is not set, although low_latency=1 was given"
    assert found[3].what == "software switches the transmitter by RTS"


def test_every_program_that_holds_the_port_is_named_but_not_the_emulator_of_the_line(
    tmp_path: Path, pty_master: PtyMaster
) -> None:
    for pid, program in ((4711, "gpsd"), (4712, "socat"), (4713, "ModemManager")):
        for folder in ("fd", "fdinfo"):
            (tmp_path / str(pid) / folder).mkdir(parents=True)
        (tmp_path / str(pid) / "fd/3").symlink_to(pty_master.path)
        (tmp_path / str(pid) / "fdinfo/3").write_text("flags:\t0100002\n")
        (tmp_path / str(pid) / "comm").write_text(f"{program}\n")
    (tmp_path / "4712/fdinfo/4").write_text(f"flags:\t0100002\ntty-index:\t{pty_master.number}\n")
    [finding] = [one for one in inspect(pty_master.path, proc=tmp_path) if one.topic == "holders"]
    assert (finding.ok, finding.what) == (False, "open in gpsd (process 4711), ModemManager (process 4713)")


def test_who_is_not_root_is_told_that_other_users_programs_cannot_be_seen(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    [finding] = [one for one in inspect(pty_master.path) if one.topic == "holders"]
    assert finding.ok
    assert finding.what == "no other program of yours has it open"
    assert "root" in finding.advice


# -- a name that lasts -----------------------------------------------------------------------------------------------


def name_of(port: str) -> Finding:
    (finding,) = [finding for finding in inspect(port) if finding.topic == "name"]
    assert finding.ok
    return finding


def test_the_name_to_use_for_an_adapter_is_said_unless_it_is_used(usb: UsbTree, pty_master: PtyMaster) -> None:
    usb.plug(pty_master.path, "A500ABC")
    finding = name_of(pty_master.path)
    assert finding.what == f"{pty_master.path} is FTDI A500ABC"
    assert finding.advice == f"name it usb:A500ABC, because {pty_master.path} can change between adapters"
    finding = name_of("usb:A500ABC")
    assert finding.what == f"{pty_master.path} is FTDI A500ABC, which usb:A500ABC finds again"
    assert not finding.advice


def test_an_adapter_without_a_serial_number_goes_by_its_place(
    usb: UsbTree, pty_master: PtyMaster, tmp_path: Path
) -> None:
    usb.plug(pty_master.path, place="1-1.2")
    assert name_of(pty_master.path).advice == "it has no serial number; leave it in this USB port"
    link = tmp_path / "links/by-path/pci-0000:00:14.0-usb-0:1.2:1.0-port0"
    link.parent.mkdir(parents=True)
    link.symlink_to(pty_master.path)
    assert name_of(pty_master.path).advice.startswith(f"name it {link}, ")
    assert not name_of(str(link)).advice


def test_a_link_by_id_is_a_name_that_stays_only_if_it_belongs_to_one_adapter(
    usb: UsbTree, pty_master: PtyMaster, tmp_path: Path
) -> None:
    with plugged() as second:
        link = tmp_path / "links/by-id/usb-FTDI_0001-if00-port0"
        by_path = tmp_path / "links/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0"
        for name in (link, by_path):
            name.parent.mkdir(parents=True)
            name.symlink_to(pty_master.path)
        usb.plug(pty_master.path, "0001", place="1-1", number=0)
        usb.plug(second.path, "0001", place="1-1", number=1)
        assert name_of(str(link)).what == f"{link} is FTDI 0001, which {link} finds again"
        usb.unplug(second.path)
        usb.plug(second.path, "0001", place="1-2", number=0)
        assert name_of(str(link)).advice == f"name it {by_path}, because {link} can change between adapters"


def test_a_serial_number_that_is_not_there_is_all_that_is_said(usb: UsbTree) -> None:
    (finding,) = inspect("usb:A500ABC")
    assert not finding.ok
    assert finding.what == "usb:A500ABC is not plugged in: no USB serial port was found"
