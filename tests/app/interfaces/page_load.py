"""What the page costs a browser: `python -m tests.app.interfaces.page_load`. It needs Chromium with its driver.

573 points of HCP2 controllers on an unpaced line, all of which change and are polled five times a second. It prints the
time from opening the page to the first values, the layout shift, and the share of the browser's main thread, in total
and by kind of work.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from busmaster import Bus, Hcp2Controller, MemoryPort, Service
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.registry import make_device
from tests.app.interfaces.browser import Browser, chromium
from tests.app.interfaces.lines import page

POINTS = 573
PERIOD = 0.2
ELEMENTS = 90
SHIFT = """
let sum = 0;
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) if (!entry.hadRecentInput) sum += entry.value;
}).observe({ type: "layout-shift", buffered: true });
await new Promise((go) => setTimeout(go, 100));
return sum;
"""
CHANGES = """
const cell = document.querySelectorAll("#point-rows td.value")[0];
let changes = 0;
const observer = new MutationObserver(() => { changes += 1; });
observer.observe(cell, { characterData: true, childList: true, subtree: true });
await new Promise((go) => setTimeout(go, given[0] * 1000));
observer.disconnect();
return changes;
"""
KINDS = ("TaskDuration", "ScriptDuration", "LayoutDuration", "RecalcStyleDuration")


def main() -> None:
    """Serve the line, show it, and print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.app.interfaces.page_load", description=__doc__)
    parser.add_argument("--seconds", type=float, default=15.0, help="how long is measured (15)")
    parser.add_argument("--points", type=int, default=POINTS, help=f"how many points there are ({POINTS})")
    options = parser.parse_args()
    asyncio.run(measure(options.points, options.seconds))


async def measure(points: int, seconds: float) -> None:
    """Measure the page with so many points."""
    places = [(1 + number // ELEMENTS, 1 + number % ELEMENTS) for number in range(points)]
    devices = {address: make_device("hcp2", address, delay=Delay(0.0)) for address in dict(places)}

    async def change() -> None:
        for count in itertools.count():
            await asyncio.sleep(PERIOD)
            for address, element in places:
                devices[address].preset(str(element), (count + element) % 1000)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, list(devices.values()), paced=False))) as bus:
            polled = [Hcp2Controller(bus, address).point(str(element)) for address, element in places]
            group = bus.poll_group("all", period=PERIOD, points=polled)
            changing = asyncio.ensure_future(change())
            async with Service(bus, path=folder / "line.sock"), page(folder) as of:
                await asyncio.to_thread(look, folder, of.url, points, seconds)
            changing.cancel()
            statistics = group.statistics()
            say(f"cycles: {statistics.cycles}, missed {statistics.missed}")


def look(folder: Path, url: str, points: int, seconds: float) -> None:
    """Open the page in a browser, and print what it costs."""
    with chromium(folder) as browser:
        browser.resize(1366, 768)
        browser.command("Performance.enable")
        began = time.monotonic()
        browser.open(url)
        browser.until("document.querySelectorAll('#point-rows td.value').length >= given[0]", min(points, 500))
        say(f"first values after {time.monotonic() - began:.2f} s")
        time.sleep(2)
        before, at = metrics(browser), time.monotonic()
        changes = browser.run(CHANGES, seconds)
        after, took = metrics(browser), time.monotonic() - at
        shares = ", ".join(f"{kind} {(after[kind] - before[kind]) / took:.1%}" for kind in KINDS)
        say(f"main thread over {took:.0f} s: {shares}")
        say(f"the first value was drawn {changes / seconds:.1f} times a second")
        say(f"layout shift: {browser.run(SHIFT):.3f}")


def metrics(browser: Browser) -> dict[str, Any]:
    """The browser's own counters, in seconds."""
    return {one["name"]: one["value"] for one in browser.command("Performance.getMetrics")["metrics"]}


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
