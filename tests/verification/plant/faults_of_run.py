"""What happens to `busmaster run` itself: signals, its terminal, its file, the clock, a supervisor."""

from __future__ import annotations

import os
import signal
import socket
import time
from pathlib import Path

from tests.verification.plant.plant import Plant, Site
from tests.verification.plant.programs import until
from tests.verification.plant.trial import Fault

ENOUGH = 20
"""Cycles that are polled while the fault lasts."""
A_YEAR = 365 * 86_400


def hangup_unchanged(plant: Plant) -> None:
    plant.run.send(signal.SIGHUP)
    plant.over()
    plant.run.heard("was reloaded", plant.fault_at)


def hangup_changed(plant: Plant) -> None:
    """Another prefix for MQTT, another file, and a group that has two points less."""
    text = plant.text().replace('points = ["winder,unwinder,dancer/2"]', 'points = ["winder/2"]')
    other = plant.paths["csv"].with_name("other.csv")
    plant.old["csv"] = [plant.paths["csv"]]
    plant.file.write_text(text.replace(str(plant.paths["csv"]), str(other)))
    plant.paths["csv"] = other
    plant.run.send(signal.SIGHUP)
    plant.over()
    plant.run.heard("was reloaded", plant.fault_at)


def hangup_broken(plant: Plant) -> None:
    plant.file.write_text(plant.text().replace("[nodes.winder]", "[nodes.winder"))
    plant.run.send(signal.SIGHUP)
    plant.over()
    plant.run.heard("reload failed", plant.fault_at)


def hangups(plant: Plant) -> None:
    for _ in range(20):
        plant.run.send(signal.SIGHUP)
    plant.over()
    plant.run.heard("was reloaded", plant.fault_at)


def terminated(plant: Plant) -> str:
    """The drive has another setpoint then."""
    plant.obeys_commands()
    status = plant.end_run()
    return f"exit status {status}; the drive was set to {setpoint(plant)} N"


def terminated_with_a_dead_node(plant: Plant) -> str:
    plant.obeys_commands()
    plant.order("off winder")
    status = plant.end_run()
    return f"exit status {status}"


def setpoint(plant: Plant) -> str:
    """What the drive took last."""
    until(lambda: any(words[0] == "took" for words in plant.said()), "the drive took something")
    return [words[3] for words in plant.said() if words[0] == "took"][-1]


def killed(plant: Plant) -> str:
    plant.obeys_commands()
    plant.wait_for_cycles(ENOUGH)
    plant.run.send(signal.SIGKILL)
    plant.run.wait()
    done = plant.once("safe", str(plant.file))
    assert (done.returncode, done.stdout) == (0, "winder/setpoint ok\n"), done
    left = setpoint(plant)
    plant.start_run()
    plant.over()
    return f"`busmaster safe` set the drive to {left} N; values in memory cannot be counted"


def stopped(plant: Plant) -> None:
    plant.run.stop()
    time.sleep(5.0)  # this is what is tried
    plant.run.go_on()
    plant.over()


def terminal_closed(plant: Plant) -> None:
    """The kernel sends SIGHUP."""
    assert plant.terminal is not None
    os.close(plant.terminal)
    plant.terminal = None
    plant.over()
    plant.run.heard("standard output failed", plant.fault_at)


def screen_killed(plant: Plant) -> None:
    process = plant.run.popen.pid
    children = [pid for found in Path(f"/proc/{process}/task").glob("*/children") for pid in found.read_text().split()]
    [screen] = children
    os.kill(int(screen), signal.SIGKILL)
    plant.over()
    plant.run.heard("the terminal was closed", plant.fault_at)


def stdout_full(plant: Plant) -> None:
    plant.disk.fill()
    plant.run.heard("standard output failed", plant.fault_at)
    plant.disk.clear()
    plant.over()
    plant.run.heard("standard output works again", plant.fault_at)


def stdin_closed(plant: Plant) -> None:
    assert plant.run.popen.stdin is not None
    plant.run.popen.stdin.close()
    plant.over()


def clock_set(seconds: int) -> Fault:
    def make(plant: Plant) -> None:
        plant.wait_for_cycles(ENOUGH)
        (plant.folder / "skew").write_text(str(seconds))
        plant.over()
        if seconds > 0:
            plant.run.heard("the clock was set", plant.fault_at)
        plant.wait_for_cycles(ENOUGH)

    name = f"the clock is set {'forward' if seconds > 0 else 'back'} by {abs(seconds) // 3600} h, with `keep_days`"
    return Fault(name=name, make=make, site=Site(sqlite="keep_days = 1", skewed=True))


def watched(plant: Plant) -> str:
    """The socket of a supervisor: a sign of life at least twice in 2 s, none while it stands still."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        address = str(plant.folder / "notify")
        manager.bind(address)
        manager.settimeout(20.0)
        plant.start_drives()
        plant.start_run(environment={"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "2000000"})
        told = ""
        while "WATCHDOG=1" not in told:
            told += f"{manager.recv(1000).decode()} "
        plant.run.stop()
        manager.setblocking(False)
        while True:  # what it had said before
            try:
                manager.recv(1000)
            except BlockingIOError:
                break
        time.sleep(2.0)  # the supervisor's patience
        try:
            raise AssertionError(f"it gives signs of life while it stands still: {manager.recv(1000)!r}")
        except BlockingIOError:
            pass
        plant.run.go_on()
        plant.over()
        manager.settimeout(20.0)
        while "WATCHDOG=1" not in manager.recv(1000).decode():
            pass
    return f"the supervisor received `{told.strip()}`, then nothing for 2 s: it would have restarted the service"


def loss_in_metrics(plant: Plant) -> str:
    plant.order("gone")
    plant.run.heard("the line is down", plant.fault_at)
    number = plant.scrape()["busmaster_line_losses_total"]
    plant.order("back")
    plant.over()
    return f"metrics: `busmaster_line_losses_total {number:g}`"


CAPTURE = Site(disk=128, arguments=("--json", "--capture", "disk/line.pcapng"))


def capture_full(plant: Plant) -> None:
    plant.disk.fill()
    plant.run.heard("the capture rests", plant.fault_at)
    plant.disk.clear()
    plant.over()
    plant.run.heard("the capture goes on", plant.fault_at)


def capture_cut_off(plant: Plant) -> str:
    plant.wait_for_cycles(ENOUGH)
    plant.run.send(signal.SIGKILL)
    plant.run.wait()
    done = plant.once("replay", "disk/line.pcapng")
    assert done.returncode == 0, done
    plant.start_run()
    plant.over()
    return f"`replay` of the capture: {done.stdout.splitlines()[-1] if done.stdout else done.stderr.strip()}"


EVERYWHERE = ("csv", "jsonl", "sqlite", "mqtt")
FAULTS = {
    "hup": Fault(name="SIGHUP, the file unchanged", make=hangup_unchanged),
    "hup-changed": Fault(name="SIGHUP, the file changed: another CSV file, fewer points", make=hangup_changed),
    "hup-broken": Fault(name="SIGHUP, the file broken", make=hangup_broken),
    "hup-twenty": Fault(name="twenty SIGHUPs at once", make=hangups),
    "term": Fault(name="SIGTERM, with [safe]", make=terminated),
    "term-dead": Fault(
        name="SIGTERM, with a dead node in [safe]", make=terminated_with_a_dead_node, status=1, site=Site(within=2.0)
    ),
    "kill": Fault(name="SIGKILL, then `busmaster safe`", make=killed, uncounted=EVERYWHERE),
    "stopped": Fault(name="`run` is stopped for 5 s", make=stopped),
    "terminal": Fault(
        name="the terminal of `run` is closed", make=terminal_closed, site=Site(arguments=("--plain",), screen=True)
    ),
    "screen": Fault(name="the screen process is killed", make=screen_killed, site=Site(arguments=(), screen=True)),
    "stdout-full": Fault(
        name="standard output goes to a full disk", make=stdout_full, site=Site(disk=64, stdout="disk/out.jsonl")
    ),
    "stdin-closed": Fault(name="standard input is closed", make=stdin_closed),
    "clock-forward": clock_set(A_YEAR),
    "clock-back": clock_set(-3600),
    "watchdog": Fault(name="`run` is stopped under a watchdog", make=watched, site=Site(starts=False)),
    "counted-loss": Fault(name="the metrics are scraped while the port is missing", make=loss_in_metrics),
    "capture-full": Fault(name="the disk of `--capture` is full", make=capture_full, site=CAPTURE),
    "capture-cut": Fault(
        name="SIGKILL, then `replay` of the capture", make=capture_cut_off, site=CAPTURE, uncounted=EVERYWHERE
    ),
}
