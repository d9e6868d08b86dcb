"""A line that is left alone: its safe state, what is told, what SIGHUP changes. Real processes, real signals."""

from __future__ import annotations

import asyncio
import os
import pty
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from termios import tcgetattr

import pytest

from busmaster.app.line import open_line
from busmaster.bus.requester import Priority
from busmaster.capture.pcapng import read_packets
from busmaster.contract.frames import Direction
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_pty
from busmaster.errors import Superseded, WriteUnconfirmed
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.registry import find, make_device
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, serve, started
from tests.app.cli.test_processes import Terminal
from tests.patience import PATIENCE
from tests.ports import free_port

TEXT = """
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", factor = 0.1 }
[groups.fast]
period = 0.05
points = ["winder/force"]
[groups.slow]
period = 0.1
points = ["winder/axis0.idle"]
"""
SAFE = '[safe]\nwithin = 1.0\nrepeatable = ["winder/force"]\nwrites = { "winder/force" = 1.5 }\n'


@pytest.fixture
def winder() -> Iterator[TcpServer]:
    with serve("hcp2", 1) as server:
        yield server


@pytest.fixture
def path(tmp_path: Path, winder: TcpServer) -> Path:
    path = tmp_path / "line.toml"
    path.write_text((TEXT + SAFE).replace("PORT", winder.path))
    return path


def force(winder: TcpServer) -> float | None:
    """What element 10 of the drive holds now: asked of the drive itself, not by another master on its line."""
    return winder.call(lambda line, now: drive_of(line).read_element(10, now))


def drive_of(line: Line) -> EmulatedMint:
    drive = line.device(1)
    assert isinstance(drive, EmulatedMint)
    return drive


def told(process: subprocess.Popen[str], what: str) -> str:
    """The first line on standard error that says so."""
    assert process.stderr is not None
    for line in process.stderr:
        if what in line:
            return line
    raise AssertionError(f"never told: {what}")


def polls(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert process.stdout.readline()


LEAVING = [(signal.SIGTERM, 0), (signal.SIGINT, 130), (signal.SIGQUIT, 131), (signal.SIGUSR1, 128 + signal.SIGUSR1)]


@pytest.mark.parametrize(("number", "status"), LEAVING)
def test_a_run_that_is_told_to_end_leaves_the_drive_in_its_safe_state(
    path: Path, winder: TcpServer, number: signal.Signals, status: int
) -> None:
    with started("run", str(path), "--plain") as process:
        polls(process)
        assert force(winder) == 0
        process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, force(winder)) == (status, 15)
    assert "safe state at the end: winder/force = 1.5 within 1 s" in err
    assert "safe state confirmed: winder/force" in err
    assert "busmaster: audit: winder/force = 1.5" in err
    assert f"by safe {number.name}" in err


@pytest.mark.slow
def test_what_a_shell_made_deaf_to_the_terminal_goes_on(path: Path) -> None:
    with subprocess.Popen(
        ["sh", "-c", 'trap "" INT QUIT; exec "$0" -m busmaster run "$1" --plain', sys.executable, str(path)],
        cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        polls(process)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGQUIT)
        process.send_signal(signal.SIGHUP)
        told(process, "was reloaded")
        process.terminate()
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT])
def test_a_safe_write_that_is_not_confirmed_is_named_and_the_status_is_1(
    path: Path, winder: TcpServer, number: signal.Signals
) -> None:
    with started("run", str(path), "--plain") as process:
        polls(process)
        winder.call(lambda line, now: line.cut(now, line.device(1)))
        process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "safe state of winder/force not confirmed: " in err


def test_safe_sends_the_safe_state_alone(busmaster: Command, path: Path, winder: TcpServer) -> None:
    outcome = busmaster("safe", str(path))
    assert (outcome.status, outcome.out, outcome.err) == (0, "winder/force ok\n", "")
    assert force(winder) == 15


def test_safe_is_recorded_and_what_cannot_be_recorded_is_sent_all_the_same(
    busmaster: Command, path: Path, winder: TcpServer, tmp_path: Path
) -> None:
    capture = tmp_path / "safe.pcapng"
    assert busmaster("safe", str(path), "--capture", str(capture)).err == ""
    with capture.open("rb") as file:
        assert {packet.direction for packet in read_packets(file)} == {Direction.HOST, Direction.NODE}
    assert busmaster("write", str(path), "winder/force=3").status == 0
    outcome = busmaster("safe", str(path), "--capture", str(tmp_path / "no" / "such"))
    assert (outcome.status, outcome.out) == (0, "winder/force ok\n")
    assert "No such file or directory" in outcome.err
    assert force(winder) == 15


@pytest.mark.parametrize(
    ("said", "error"),
    [
        ('writes = { "winder/force" = 1 }', "is not repeatable"),
        ('writes = { "winder/axis0.idle" = 1 }', "read-only"),
        (
            'writes = { "winder/force" = 1, "winder/10" = 2 }\nrepeatable = ["winder/force", "winder/10"]',
            "same quantity",
        ),
        ('writes = { "winder/force" = [1, 2] }', "must be one value"),
        ("within = 1", "a safe state needs writes"),
        ('writes = { "winder/force" = 1 }\nrepeatable = ["winder/11"]', "is not in writes"),
    ],
)
def test_what_cannot_be_a_safe_write_is_refused_when_the_file_is_read(
    busmaster: Command, path: Path, said: str, error: str
) -> None:
    path.write_text(path.read_text().partition("[safe]")[0] + f"[safe]\n{said}\n")
    outcome = busmaster("run", str(path), "--seconds", "0.1")
    assert outcome.status == 2
    assert error in outcome.err


@pytest.mark.parametrize(
    ("port", "reason"),
    [
        ("FOLDER/away", "FOLDER/away does not exist"),
        ("FOLDER/line.toml", "FOLDER/line.toml is not a serial port"),
        ("socket://127.0.0.1:FREE", "127.0.0.1:FREE refused the connection"),
    ],
)
def test_safe_says_why_the_port_is_refused_and_names_each_point(
    busmaster: Command, path: Path, port: str, reason: str
) -> None:
    free = str(free_port())
    path.write_text(path.read_text().replace("within = 1.0", "within = 0.2"))
    port, reason = (text.replace("FOLDER", str(path.parent)).replace("FREE", free) for text in (port, reason))
    outcome = busmaster("safe", str(path), "--port", port)
    first, *rest = outcome.err.splitlines()
    assert (outcome.status, outcome.out) == (1, "")
    assert first.startswith(f"busmaster: cannot connect: {reason}")
    assert [line.partition(" not")[0] for line in rest] == ["busmaster: safe state of winder/force"]


@pytest.mark.slow
def test_safe_says_who_has_the_port_and_serves_it_to_nobody(busmaster: Command, path: Path) -> None:
    with serve_pty(Line(find("hcp2").profile.line, [make_device("hcp2", 1)], paced=False)) as served:
        text = f"{TEXT}{SAFE}[service]\nenabled = false\n".replace("PORT", served.path)
        path.write_text(text.replace("within = 1.0", "within = 0.2"))
        with started("run", str(path), "--plain") as process:
            polls(process)
            outcome = busmaster("safe", str(path))
            process.terminate()
            process.communicate(timeout=PATIENCE)
    assert outcome.status == 1
    assert f"{served.path} is in use by " in outcome.err
    assert "safe state of winder/force not confirmed: " in outcome.err


def test_safe_without_a_safe_state_is_wrong_usage(busmaster: Command, path: Path) -> None:
    path.write_text(path.read_text().partition("[safe]")[0])
    assert busmaster("safe", str(path)).status == 2


@pytest.mark.slow
def test_sighup_replaces_what_changed_and_leaves_the_rest_unbroken(path: Path) -> None:
    with started("run", str(path), "--plain") as process:
        polls(process)
        told(process, "safe state")
        text = path.read_text()
        path.write_text(text.replace("axis0.idle", "axis0.position"))
        process.send_signal(signal.SIGHUP)
        told(process, "was reloaded")
        assert process.stdout is not None
        assert any("axis0.position" in line for line in process.stdout)
        path.write_text(text.replace("[nodes.winder]", "[nodes.winder"))
        process.send_signal(signal.SIGHUP)
        assert "nothing was changed" in told(process, "reload failed")
        path.write_text(text.replace("57600", "9600"))
        process.send_signal(signal.SIGHUP)
        assert told(process, "reload failed").endswith("nothing was changed: changes of the port need a restart\n")
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    [fast] = [line for line in err.splitlines() if line.startswith("busmaster: fast: ")]
    assert int(fast.split()[2]) > 1


@pytest.mark.slow
def test_a_port_that_is_missing_at_the_start_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(TEXT.replace("PORT", f"socket://127.0.0.1:{free_port()}"))
    with started("run", str(path), "--json") as process:
        told(process, "cannot connect")
        with started("emulate", str(path)) as emulated:
            told(process, "the line is up")
            process.terminate()
            process.communicate(timeout=PATIENCE)
            emulated.terminate()
            emulated.communicate(timeout=PATIENCE)
    assert process.returncode == 0


@pytest.mark.slow
def test_systemd_hears_that_it_is_ready_lives_reloads_and_stops(path: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        environment = ENVIRONMENT | {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
        read, write = os.pipe()
        status = os.fstat(write)
        environment["JOURNAL_STREAM"] = f"{status.st_dev}:{status.st_ino}"
        process = subprocess.Popen(
            [sys.executable, "-m", "busmaster", "run", str(path)],
            cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=write,
        )  # fmt: skip
        os.close(write)

        def until(what: str) -> None:
            while not manager.recv(1000).decode().startswith(what):
                pass

        until("READY=1")
        until("WATCHDOG=1")
        process.send_signal(signal.SIGHUP)
        until("RELOADING=1\nMONOTONIC_USEC=")
        until("READY=1")
        process.terminate()
        until("STOPPING=1")
        assert process.wait(PATIENCE) == 0
        with open(read, encoding="utf-8") as journal:
            assert all(line.startswith(("<5>busmaster: ", "<6>busmaster: ")) for line in journal)


@pytest.mark.slow
def test_a_full_disk_under_standard_output_does_not_end_a_run(path: Path, winder: TcpServer) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        process = subprocess.Popen(
            [sys.executable, "-m", "busmaster", "run", str(path)],
            cwd=ROOT, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    told(process, "standard output failed: No space left on device")
    process.terminate()
    process.communicate(timeout=PATIENCE)
    assert (process.returncode, force(winder)) == (0, 15)


@pytest.mark.slow
def test_a_terminal_that_is_closed_does_not_end_a_run(path: Path, winder: TcpServer) -> None:
    pid, master = pty.fork()
    if not pid:
        os.chdir(ROOT)
        os.execve(sys.executable, [sys.executable, "-m", "busmaster", "run", str(path), "--plain"], ENVIRONMENT)
    drawn = b""
    while b"winder/force 0" not in drawn:
        drawn += os.read(master, 4096)
    os.close(master)  # the kernel sends SIGHUP
    winder.call(lambda line, now: drive_of(line).write_element(10, 7.0, now))
    os.kill(pid, signal.SIGTERM)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert force(winder) == 15


@pytest.mark.slow
def test_a_drawing_process_that_is_killed_does_not_end_a_run(path: Path, winder: TcpServer) -> None:
    terminal = Terminal("run", str(path))
    try:
        terminal.until(lambda drawn: b"\x1b[?1049h" in drawn and b"force" in drawn.partition(b"\x1b[?1049h")[2])
        process = terminal.process.pid
        [screen] = [
            pid for found in Path(f"/proc/{process}/task").glob("*/children") for pid in found.read_text().split()
        ]
        os.kill(int(screen), signal.SIGKILL)
        terminal.until(lambda drawn: b"polling continues without it" in drawn)
        terminal.process.terminate()
        assert terminal.status() == 0
        assert tcgetattr(terminal.slave) == terminal.before
    finally:
        terminal.close()
    assert force(winder) == 15


@pytest.mark.asyncio
async def test_from_the_safe_state_on_no_other_write_is_accepted_and_waiting_ones_are_superseded(
    path: Path, winder: TcpServer
) -> None:
    async with open_line(path) as line:
        winder.call(lambda line, now: line.cut(now, line.device(1)))
        drive = line.nodes["winder"]
        waiting = [asyncio.ensure_future(drive.write(10 + number, 1.0)) for number in range(3)]
        await asyncio.sleep(0)
        leaving = asyncio.ensure_future(line.safe_state.enter(line.authorisation, "a test"))
        await asyncio.sleep(0)
        with pytest.raises(Superseded):
            await drive.write(20, 1.0, priority=Priority.URGENT)
        winder.call(lambda line, now: line.restore(now))
        assert await leaving == {"winder/force": None}
        ended = await asyncio.gather(*waiting, return_exceptions=True)
    assert all(isinstance(error, Superseded | WriteUnconfirmed) for error in ended)
    assert sum(isinstance(error, Superseded) for error in ended) >= 2


EARLY = """
import os, signal, sys
from busmaster.app.cli import main, run

def load(path, load=run.load):
    os.kill(os.getpid(), signal.SIGHUP)
    return load(path)

run.load = load
sys.exit(main(["run", sys.argv[1], "--plain"]))
"""


@pytest.mark.slow
def test_sighup_before_the_file_is_loaded_does_not_end_a_run(path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", EARLY, str(path)],
        cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        told(process, "was reloaded")
        polls(process)
        process.terminate()
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 0


SPILLING = '[outputs.jsonl]\npath = "FOLDER/line.jsonl"\nspill = "FOLDER/spool"\n'


@pytest.mark.slow
def test_a_spool_is_handed_over_at_sighup_and_a_damaged_one_is_told(path: Path, tmp_path: Path) -> None:
    (tmp_path / "spool").write_text("not a database at all " * 400)
    path.write_text(path.read_text() + SPILLING.replace("FOLDER", str(tmp_path)))
    with started("run", str(path), "--plain") as process:
        assert "it is kept as" in told(process, "begun anew")
        polls(process)
        path.write_text(path.read_text() + "buffer = 1000\n")
        process.send_signal(signal.SIGHUP)
        told(process, "was reloaded")
        path.write_text(path.read_text().replace("buffer = 1000", "buffer = 1001"))
        process.send_signal(signal.SIGHUP)
        told(process, "was reloaded")
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE)
    assert "does another process use it" not in err
    [summary] = [line for line in err.splitlines() if line.startswith("busmaster: jsonl: ")]
    assert summary.endswith(" written, 0 dropped")
