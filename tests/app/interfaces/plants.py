"""A line with long names, runs of registers and alarms, its emulated drives and its page: each a process of its own."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx2 as httpx

from tests.app.cli.conftest import ENVIRONMENT, ROOT
from tests.app.interfaces.browser import Browser
from tests.patience import PATIENCE
from tests.ports import free_port

CALM, NODE_DOWN, LINE_LOST = SITUATIONS = ("calm", "node down", "line lost")
DEAD_DRIVE = "unwinder-station-right-side"
RECIPE = [65535 - number for number in range(100)]
TEXT = """
title = "Slitter hall 3, line 12, left"
port = "socket://127.0.0.1:{port}?baudrate=115200"
[nodes.unwinder-station-left-side]
protocol = "modbus"
address = 1
[nodes.unwinder-station-left-side.points]
temperature_of_the_bearing_on_the_drive_side = {{ item = "holding:100", unit = "°C", factor = 0.1, precision = 1 }}
nameWithoutAnyPlaceInWhichALineCouldEndSoThatItHasToBeBroken = {{ item = "holding:101", unit = "m/min" }}
recipe = {{ item = "holding:200:100" }}
brake = {{ item = "coil:5" }}
mode = {{ item = "holding:1", labels = {{ 0 = "waiting for the release", 1 = "jog" }} }}
speed = {{ item = "holding:3:float32", unit = "m/min", precision = 3, low = 1 }}
large = {{ item = "holding:40:uint32", unit = "increments", factor = -1, offset = -4000000000.0, precision = 3 }}
inputs = {{ item = "discrete:0:16" }}
[nodes.unwinder-station-left-side.points.status]
item = "holding:2"
bits = {{ READY = 0, FAULT = 3, EMERGENCY_STOP_OF_THE_LEFT_SIDE = 4 }}
alarm_if_clear = ["READY"]
alarm_if_set = ["FAULT"]
[nodes.{dead}]
protocol = "modbus"
address = 2
points.force = {{ item = "holding:10", unit = "N", minimum = 0, maximum = 500 }}
[nodes.press-3-8]
protocol = "modbus"
address = "3-8"
[groups.fast]
period = 0.2
points = [
    "unwinder-station-left-side/temperature_of_the_bearing_on_the_drive_side,recipe,brake,mode,status,speed,inputs",
    "unwinder-station-left-side/large,nameWithoutAnyPlaceInWhichALineCouldEndSoThatItHasToBeBroken",
    "{dead}/force,holding:11,coil:1",
]
[groups.the_slow_ones_of_both_sides_of_the_line]
period = 0.5
points = ["press-3-8/holding:1"]
[emulator.nodes.unwinder-station-left-side.values]
status = 8
recipe = {recipe}
[emulator.nodes.{dead}]
faults = {{ dead = {is_dead} }}
"""


def showing(situation: str) -> str:
    """What is true of the page once it shows a situation."""
    rows = "document.querySelectorAll('#point-rows td.value').length > 20"
    health = "document.getElementById('health').textContent"
    state = "document.documentElement.dataset.state"
    bad = "[...document.querySelectorAll('td.quality')].filter((one) => one.textContent.includes('bad')).length"
    facts = {
        CALM: f"{state} === 'ready' && {health}.includes('none down')",
        NODE_DOWN: f"{state} === 'ready' && {health}.includes('1 of 8 nodes down') && {bad} > 2",
        LINE_LOST: f"{state} === 'offline'",
    }
    return f"{rows} && {facts[situation]}"


@contextlib.contextmanager
def plant(folder: Path, situation: str) -> Iterator[str]:
    """Run the line in a situation, and yield its page's URL. A line that is lost had values before."""
    file = folder / "slitter.toml"
    is_dead = 1.0 if situation == NODE_DOWN else 0.0
    file.write_text(TEXT.format(port=free_port(), dead=DEAD_DRIVE, is_dead=is_dead, recipe=RECIPE))
    with contextlib.ExitStack() as stack:

        def start(*arguments: str) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, "-m", "busmaster", *arguments],
                cwd=ROOT,
                env={**ENVIRONMENT, "XDG_RUNTIME_DIR": str(folder)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            assert process.stdout is not None
            stack.callback(process.stdout.close)
            stack.callback(process.wait, PATIENCE)
            stack.callback(process.terminate)
            return process

        drives = start("emulate", str(file))
        printed(drives, "socket://")
        printed(start("serve", str(file)), "is served at")
        page = printed(start("web", "slitter", "--bind", "127.0.0.1:0"), "the page is at").split()[-1]
        if situation != NODE_DOWN:  # a page that is opened before the first cycle moves when its values arrive
            wait_for_values(page)
        if situation == LINE_LOST:
            drives.terminate()
        yield page


def wait_for_values(page: str) -> None:
    """Wait until each point has a value."""
    with httpx.Client(base_url=page, timeout=PATIENCE, trust_env=False) as client:
        while not (points := client.get("/api/points").json()) or any(one["value"] is None for one in points):
            time.sleep(0.05)


def printed(process: subprocess.Popen[str], words: str) -> str:
    """Wait until a program has printed these words, and return their line."""
    assert process.stdout is not None
    before = []
    for line in process.stdout:
        if words in line:
            return line
        before.append(line)
    raise AssertionError(f"{process.args!r} ended without {words!r}: {''.join(before)}")


def open_page(browser: Browser, url: str, situation: str) -> None:
    """Open the page, and wait until it shows the situation and all its rows are filled."""
    browser.open(url)
    browser.until(showing(situation))
    browser.until("document.fonts.status === 'loaded'")
