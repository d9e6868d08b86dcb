"""The plot of a point's history in a real Chromium: what it requests, what it shows, and how it zooms and moves."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest

from busmaster.app.outputs.history import History, Part, PastSample
from tests.app.interfaces.browser import Browser, chromium, needs_chromium
from tests.app.interfaces.lines import Page, Past, page, poll, shows
from tests.app.service.lines import served, until

pytestmark = [needs_chromium(), pytest.mark.slow]

ROWS = "document.querySelectorAll('#point-rows button.name').length"
OPENED = "document.querySelector('#point-rows button.name').click()"
NOTE = "document.getElementById('plot-note').textContent"
COLOURED = """
const canvas = document.getElementById("plot-canvas"), { width, height } = canvas;
const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
const probe = document.createElement("canvas").getContext("2d");
probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(`--${given[0]}`).trim();
probe.fillRect(0, 0, 1, 1);
const [r, g, b] = probe.getImageData(0, 0, 1, 1).data, columns = new Set();
for (let at = 0; at < data.length; at += 4)
  if (data[at] === r && data[at + 1] === g && data[at + 2] === b && data[at + 3] === 255) columns.add((at / 4) % width);
return [...columns].sort((one, other) => one - other);
"""
"""The columns of the plot that have a pixel of a colour of the page."""


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("chromium")) as browser:
        yield browser


@contextlib.asynccontextmanager
async def opened(browser: Browser, folder: Path, past: Past | None) -> AsyncIterator[Page]:
    """The page of a line whose first point a person has opened. The line has no values later than now."""
    browser.open("about:blank")
    browser.resize(1400, 1000)
    browser.complaints()
    async with served(folder) as line, page(folder, history=past) as of:
        poll(line)
        await shows(of.line)
        await asyncio.to_thread(browser.open, of.url)
        await asyncio.to_thread(browser.until, ROWS)
        await asyncio.to_thread(browser.run, OPENED)
        yield of
        complaints = [text for text in browser.complaints() if "willReadFrequently" not in text]  # of COLOURED
        assert complaints == []


async def says(browser: Browser, text: str) -> None:
    await asyncio.to_thread(browser.until, f"{NOTE}.includes(given[0])", text)


async def columns(browser: Browser, colour: str) -> list[int]:
    found: list[int] = await asyncio.to_thread(browser.run, COLOURED, colour)
    return found


async def has_drawn(browser: Browser, colour: str) -> None:
    """Wait until the plot has a column of this colour: it is drawn with the next frame."""
    await asyncio.to_thread(browser.until, f"(() => {{ {COLOURED} }})().length", colour)


def choosing(span: str) -> str:
    """A script by which a person chooses a range of so many seconds."""
    of = "document.getElementById('plot-span')"
    return f"{of}.value = '{span}'; {of}.dispatchEvent(new Event('change'))"


def samples(*ages: float, error_at: float | None = None) -> History:
    """Samples of so many seconds ago, the oldest first: 12.5, or an error."""
    now = time.time()
    good = {age: PastSample(now - age, 12.5, "good", None) for age in ages}
    if error_at is not None:
        good[error_at] = PastSample(now - error_at, None, "bad", "no reply")
    return History(tuple(good.values()))


@pytest.mark.asyncio
async def test_a_point_opens_with_the_hour_that_the_database_has(window: Browser, tmp_path: Path) -> None:
    past = Past(samples(1800, 1200, 600, error_at=1200))
    async with opened(window, tmp_path, past):
        await says(window, "to now: ")
        await until(lambda: bool(past.requests))
        key, _, begin, end, limit = past.requests[0]
        assert key == "5/10"
        assert end - begin == pytest.approx(3600, abs=1)
        assert abs(end - time.time()) < 60
        assert 100 <= limit <= 1000
        width = await asyncio.to_thread(window.run, "return document.getElementById('plot-canvas').width")
        await asyncio.to_thread(window.until, f"{NOTE}.match(/to now: [1-9]/)")
        drawn, errors = await columns(window, "ok"), await columns(window, "bad")
        assert drawn[0] < width * 0.6 < drawn[-1], "the first sample is of half an hour ago, the last ones of now"
        assert any(width * 0.6 < column < width * 0.75 for column in errors), "the error is of 20 minutes ago"


@pytest.mark.asyncio
async def test_buttons_keys_wheel_and_drag_zoom_and_move_it(window: Browser, tmp_path: Path) -> None:
    past = Past(samples(1800, 600))
    async with opened(window, tmp_path, past):
        await until(lambda: bool(past.requests))

        async def after(act: str, span: float, ends: Callable[[float], bool] = lambda end: True) -> tuple[float, float]:
            """Begin and end of what is requested after an act of a person, once it has this span and such an end."""
            await asyncio.to_thread(window.run, act)

            def found() -> bool:
                begin, end = past.requests[-1][2:4]
                return abs(end - begin - span) < 1 and ends(end)

            await until(found)
            return past.requests[-1][2], past.requests[-1][3]

        def press(key: str) -> str:
            event = f"new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }})"
            return f"document.getElementById('plot-canvas').dispatchEvent({event})"

        def is_now(end: float) -> bool:
            return abs(end - time.time()) < 60

        _, end = await after("document.getElementById('plot-in').click()", 2400, is_now)
        moved = await after(press("ArrowLeft"), 2400, lambda until: 500 < end - until < 700)
        zoomed = await after(press("+"), 1600)
        assert sum(zoomed) == pytest.approx(sum(moved), abs=1), "the middle stays"
        wheel = """
        const canvas = document.getElementById('plot-canvas'), box = canvas.getBoundingClientRect();
        const at = { deltaY: 100, clientX: box.left + 54, bubbles: true, cancelable: true };
        canvas.dispatchEvent(new WheelEvent('wheel', at));
        """
        wheeled = await after(wheel, 2400)
        assert wheeled[0] == pytest.approx(zoomed[0], abs=1), "the time at the pointer stays"
        drag = """
        const canvas = document.getElementById('plot-canvas'), { left, top } = canvas.getBoundingClientRect();
        canvas.setPointerCapture = () => {};
        const at = (kind, x) => canvas.dispatchEvent(
          new PointerEvent(kind, { clientX: left + x, clientY: top + 50, bubbles: true }));
        at('pointerdown', 300); at('pointermove', 400); at('pointerup', 400);
        """
        await after(drag, 2400, lambda end: 100 < wheeled[1] - end < 1000)
        await after(press("End"), 2400, is_now)
        await after(choosing("86400"), 86400, is_now)


@pytest.mark.asyncio
async def test_what_is_pointed_at_is_described(window: Browser, tmp_path: Path) -> None:
    now = time.time()
    past = Past(History(parts=(Part(now - 3000, now - 2000, -3.5, 8.25, 400, 2),), labels=()))
    async with opened(window, tmp_path, past):
        await says(window, " values")
        await until(lambda: bool(past.requests))
        await asyncio.to_thread(window.until, f"{NOTE}.match(/: 4\\d\\d values/)")
        await asyncio.to_thread(window.point_at, "#plot-canvas", -100, 0)
        await says(window, "400 values: -3.5 to 8.25, 2 without a value")


@pytest.mark.asyncio
async def test_a_history_that_cannot_be_read_is_told_and_the_last_values_are_shown(
    window: Browser, tmp_path: Path
) -> None:
    async with opened(window, tmp_path, Past(OSError("the history x.db cannot be read: it is locked"))):
        await says(window, "✕ the history x.db cannot be read: it is locked")
        await asyncio.to_thread(window.run, choosing("60"))
        await has_drawn(window, "ok")
        window.complaints()  # Chromium logs each reply that is an error


@pytest.mark.asyncio
async def test_without_a_database_the_last_values_are_there_and_can_be_zoomed(window: Browser, tmp_path: Path) -> None:
    async with opened(window, tmp_path, None):
        await says(window, "started without --history")
        await asyncio.to_thread(window.until, f"{NOTE}.match(/to now: [1-9]/)")
        before = await asyncio.to_thread(window.run, f"return {NOTE}")
        await asyncio.to_thread(window.run, "document.getElementById('plot-out').click()")
        assert await asyncio.to_thread(window.run, f"return {NOTE}") != before
        await has_drawn(window, "ok")
