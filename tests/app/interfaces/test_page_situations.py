"""The page in a real browser while something is gone: what a person reads there, by words and not by the page's parts.

docs/monitoring.md says what all consumers report in these situations.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, Service
from busmaster.app.interfaces import following
from busmaster.app.service.authorisation import Authorisation
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryTransport
from busmaster.errors import LineDown
from busmaster.registry import make_device
from tests.app.interfaces.browser import Browser, chromium, needs_chromium
from tests.app.interfaces.lines import page
from tests.patience import PATIENCE

pytestmark = needs_chromium()
SHOWN = "document.body.innerText"
"""What is drawn; what is hidden is not in it."""
NOTHING = "a word that no page has"
UP, DOWN, OFFLINE, NONE_DOWN = "✓ up", "✕ down", "✕ offline", "none down"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("browser")) as opened:
        opened.resize(1366, 768)
        yield opened


async def reads(browser: Browser, *words: str, without: str = NOTHING) -> str:
    """Wait until a person reads all of these words, and not the one; return all that is to be read then."""
    fact = f"given[1].every((word) => {SHOWN}.includes(word)) && !{SHOWN}.includes(given[0]) && {SHOWN}"
    return str(await asyncio.to_thread(browser.until, fact, without, words))


@pytest.mark.slow
@pytest.mark.asyncio
async def test_a_person_reads_of_a_dead_drive_a_lost_line_and_an_owner_that_is_away(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)
    devices = [make_device("hcp2", 5), make_device("hcp2", 6)]
    port = MemoryPort(Line(Hcp2Controller.profile.line, devices, paced=False))
    opens = MemoryPort.open
    async with asyncio.timeout(PATIENCE), page(tmp_path) as of:
        async with Bus(port) as bus:
            points = [Hcp2Controller(bus, address).point("10") for address in (5, 6)]
            bus.poll_group("axes", period=0.05, points=points)
            async with Service(bus, authorisation=Authorisation(bus), path=tmp_path / "line.sock"):
                await asyncio.to_thread(browser.open, of.url)
                await reads(browser, "node 5", "node 6", UP, NONE_DOWN, "ready")
                devices[1].faults.dead = 1.0
                await reads(browser, "1 of 2", UP, DOWN, "polling suspended", without=NONE_DOWN)
                devices[1].faults.dead = 0.0
                await reads(browser, UP, NONE_DOWN, without=DOWN)

                async def stays_away(*_: object, **__: object) -> None:
                    raise LineDown("unplugged")

                monkeypatch.setattr(MemoryPort, "open", stays_away)
                transport = bus._pump._transport
                assert isinstance(transport, MemoryTransport)
                transport.lose(OSError("unplugged"))
                text = await reads(browser, "The line is lost", "unplugged", OFFLINE, without=UP)
                assert NONE_DOWN not in text
                monkeypatch.setattr(MemoryPort, "open", opens)
                await reads(browser, UP, NONE_DOWN, without=OFFLINE)
        await reads(browser, "the values are old", "2 nodes offline", "owner away", OFFLINE, without=UP)
        assert browser.complaints() == []


@pytest.mark.slow
@pytest.mark.asyncio
async def test_the_row_of_a_paused_group_is_drawn_as_old_until_the_group_goes_on(
    browser: Browser, tmp_path: Path
) -> None:
    is_old = "given[0] === document.querySelector('#point-rows .point')?.classList.contains('old')"
    port = MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False))
    async with asyncio.timeout(PATIENCE), page(tmp_path) as of, Bus(port) as bus:
        group = bus.poll_group("axes", period=0.05, points=[Hcp2Controller(bus, 5).point("10")])
        async with Service(bus, authorisation=Authorisation(bus), path=tmp_path / "line.sock"):
            await asyncio.to_thread(browser.open, of.url)
            await reads(browser, "node 5", UP)
            await asyncio.to_thread(browser.until, is_old, False)
            group.pause()
            await asyncio.to_thread(browser.until, is_old, True)
            group.resume()
            await asyncio.to_thread(browser.until, is_old, False)
