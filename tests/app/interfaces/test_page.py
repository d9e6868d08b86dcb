"""The page in a real Chromium: in the states that an operator meets, light and dark, on a phone, by the keyboard."""

from __future__ import annotations

import asyncio
import contextlib
import http.server
import threading
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, Service
from busmaster.app.service.permission import Access, digest_of
from busmaster.bus.limits import Limit
from busmaster.bus.meaning import Meaning
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.line import Line
from busmaster.registry import make_device
from tests.app.interfaces.browser import Browser, chromium, needs_chromium
from tests.app.interfaces.lines import READS, Page, page, poll, shows
from tests.app.service.lines import Served, served, until

pytestmark = [needs_chromium(), pytest.mark.slow]

ENTER, TAB, LEFT, ESCAPE = "\ue007", "\ue004", "\ue012", "\ue00c"
READY = "document.documentElement.dataset.state === 'ready' && document.querySelector('#point-rows td.value')"
TOKEN = "0123456789abcdef"
ATTACK, LEAST_CONTRAST = Path(__file__).with_name("attack.js"), Path(__file__).with_name("contrast.js")


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("chromium"), hosts="MAP rebound.example 127.0.0.1") as browser:
        yield browser


@pytest.fixture
def browser(window: Browser) -> Browser:
    """A window that has no page yet, as wide as a screen, light."""
    window.open("about:blank")
    window.resize(1400, 1000)
    window.prefer("light")
    window.complaints()
    return window


async def says(browser: Browser, selector: str, text: str) -> None:
    """Wait until an element of the page says it."""
    fact = "document.querySelector(given[0])?.textContent.includes(given[1])"
    await asyncio.to_thread(browser.until, fact, selector, text)


@contextlib.asynccontextmanager
async def shown(browser: Browser, folder: Path, **options: object) -> AsyncIterator[tuple[Served, Page]]:
    """A line of one node with its page, which the browser has opened and which shows values."""
    async with served(folder) as line, page(folder, **options) as of:  # type: ignore[arg-type]  # the page's own
        poll(line)
        await shows(of.line)
        await asyncio.to_thread(browser.open, of.url)
        await asyncio.to_thread(browser.until, READY)
        yield line, of


@contextlib.asynccontextmanager
async def forty(folder: Path) -> AsyncIterator[Bus]:
    """A served line of forty nodes, of which the seventeenth is not there."""
    devices = [make_device("hcp2", number) for number in range(1, 41) if number != 17]
    async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, devices, paced=False))) as bus:
        quick = Timings.uniform(ReplyTiming(0.02, 0.02, 0.02, 0.002))
        controllers = [Hcp2Controller(bus, number, timings=quick) for number in range(1, 41)]
        points = [one.point(item) for one in controllers for item in ("10", "axis0.position")]
        bus.poll_group("drives", period=1.0, points=points)
        async with Service(bus, path=folder / "line.sock", title="Slitter"):
            yield bus


@pytest.mark.asyncio
async def test_it_shows_values_nodes_groups_events_and_the_wire_and_complains_of_nothing(
    browser: Browser, tmp_path: Path
) -> None:
    async with shown(browser, tmp_path) as (line, of):
        await of.client.put("/api/points/axes/5/10", json={"value": 7})
        await asyncio.to_thread(browser.until, "document.querySelector('#point-rows td.value').textContent === '7'")
        assert await asyncio.to_thread(browser.text, "#state") == "● ready"
        await says(browser, "#node-list", "✓ up")
        await asyncio.to_thread(browser.until, "document.querySelector('#group-rows th').textContent === 'axes'")
        await until(lambda: line.bus._pump.tap is not None)
        assert browser.complaints() == []


@pytest.mark.asyncio
async def test_on_hovering_an_exchange_says_what_was_said_and_the_arrow_keys_go_through_them(
    browser: Browser, tmp_path: Path
) -> None:
    async with shown(browser, tmp_path):
        await asyncio.to_thread(browser.run, "document.getElementById('wire-canvas').focus()")
        await asyncio.to_thread(exchanges_are_drawn, browser)
        await asyncio.to_thread(browser.press, LEFT)
        await says(browser, "#wire-text", "read ")
        text = await asyncio.to_thread(browser.text, "#wire-text")
        assert "→" in text
        assert "first byte after" in text
        assert await asyncio.to_thread(browser.text, "#hold") == "Go on"  # it holds still while it is read
        await asyncio.to_thread(browser.press, LEFT)
        await asyncio.to_thread(browser.until, "document.getElementById('wire-text').textContent !== given[0]", text)
        found = await asyncio.to_thread(
            browser.run,
            """
            const canvas = document.getElementById('wire-canvas'), box = canvas.getBoundingClientRect();
            for (let x = 70; x < box.width; x++) {
              const at = { clientX: box.left + x, clientY: box.top + 28, bubbles: true };
              canvas.dispatchEvent(new PointerEvent('pointermove', at));
              const tip = document.getElementById('tip');
              if (!tip.hidden && tip.textContent.includes('read ')) return tip.textContent;
            }
            return '';
            """,
        )
        assert "→ +0.0 ms" in found


@pytest.mark.asyncio
async def test_where_another_node_is_asked_the_lane_of_a_node_says_with_whom_the_line_is_busy(
    browser: Browser, tmp_path: Path
) -> None:
    async with forty(tmp_path), page(tmp_path) as of:
        await shows(of.line)
        await asyncio.to_thread(browser.open, of.url)
        await asyncio.to_thread(
            browser.until,
            """(() => {
              const canvas = document.getElementById('wire-canvas'), box = canvas.getBoundingClientRect();
              for (let x = 70; x < box.width; x++) {
                const at = { clientX: box.left + x, clientY: box.top + 50, bubbles: true };
                canvas.dispatchEvent(new PointerEvent('pointermove', at));
                if (document.getElementById('tip').textContent === 'busy with node 20') return true;
              }
            })()""",
        )


@pytest.mark.asyncio
async def test_a_good_value_that_is_a_text_is_not_drawn_as_one_that_is_missing(
    browser: Browser, tmp_path: Path
) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line, replace(Hcp2Controller(line.bus, 5).point("20"), meaning=Meaning(labels={0: "off"})))
        await shows(of.line)
        await asyncio.to_thread(browser.open, of.url)
        blank = """
            [...document.querySelectorAll('#point-rows canvas')].map((canvas) => {
              const drawn = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
              return parseInt(canvas.ariaLabel.split(' ')[2]) > 5 && drawn.every((part) => part === 0);
            })
        """
        await asyncio.to_thread(browser.until, f"`${{{blank}}}` === 'false,false,true'")


def exchanges_are_drawn(browser: Browser) -> None:
    """Wait until the line's lane has the colour of exchanges that were answered in two places, between the rules."""
    browser.until(
        """(() => {
          const canvas = document.getElementById('wire-canvas'), pen = canvas.getContext('2d');
          const row = pen.getImageData(70, 30, canvas.width - 70, 1).data;
          let places = 0, within = false;
          for (let at = 0; at < row.length; at += 4) {
            const answered = `${row.slice(at, at + 3)}` === '0,114,178';
            places += answered && !within;
            within = answered;
          }
          return places > 1;
        })()"""
    )


@pytest.mark.asyncio
async def test_a_write_is_asked_twice_by_the_keyboard_alone_and_its_limits_are_shown(
    browser: Browser, tmp_path: Path
) -> None:
    async with shown(browser, tmp_path) as (line, _):
        point = Hcp2Controller(line.bus, 5).point("10")
        point.node.limit(Limit(name=point.key, read=point.command, decode=point.value_of, maximum=50))
        await asyncio.to_thread(browser.run, "document.querySelector('#point-rows button.name').focus()")
        await asyncio.to_thread(browser.press, ENTER)
        await says(browser, "#write-limits", "at most 50")
        await asyncio.to_thread(browser.press, "5", "1", ENTER)
        await says(browser, "#outcome", "above the limit of 50")
        await asyncio.to_thread(browser.press, "\ue003", "\ue003", "1", "2", ENTER)
        await asyncio.to_thread(browser.until, "!document.getElementById('ask').hidden")
        assert await asyncio.to_thread(browser.text, "#go") == "Write 12"
        assert line.records == []  # nothing is written before it is confirmed
        await asyncio.to_thread(browser.press, ENTER)
        await says(browser, "#outcome", "was written")
        assert line.audit() == [("5/10", "written")]
        await asyncio.to_thread(browser.press, ESCAPE)
        await asyncio.to_thread(browser.until, "!document.getElementById('point').open")
        assert browser.complaints() == []


@pytest.mark.asyncio
async def test_a_write_that_the_line_refuses_is_said_in_its_words(browser: Browser, tmp_path: Path) -> None:
    async with shown(browser, tmp_path) as (line, _):
        line.authorisation.read_only = True
        await asyncio.to_thread(browser.until, "document.getElementById('mode').textContent === 'read-only'")
        await asyncio.to_thread(browser.click, "#point-rows button.name")
        await asyncio.to_thread(browser.until, "!document.getElementById('no-write').hidden")
        assert line.records == []


@pytest.mark.asyncio
async def test_what_the_interfaces_role_no_longer_allows_is_offered_no_longer(browser: Browser, tmp_path: Path) -> None:
    async with shown(browser, tmp_path) as (line, _):
        await asyncio.to_thread(browser.until, "!document.querySelector('#point-rows td:last-child button').hidden")
        await asyncio.to_thread(browser.click, "#point-rows button.name")
        await asyncio.to_thread(browser.type, "#new-value", "3")
        await asyncio.to_thread(browser.press, ENTER)
        await asyncio.to_thread(browser.until, "!document.getElementById('ask').hidden")
        line.authorisation.access = READS
        await asyncio.to_thread(browser.until, "!document.getElementById('no-write').hidden")
        assert await asyncio.to_thread(browser.run, "return document.getElementById('go').hidden")
        assert await asyncio.to_thread(browser.run, "return document.getElementById('ask').hidden")
        assert await asyncio.to_thread(browser.text, "#mode") == "read-only"
        await asyncio.to_thread(
            browser.until,
            "[...document.querySelectorAll('#point-rows td:last-child button')].every((one) => one.hidden)",
        )
        line.authorisation.access = Access()
        await asyncio.to_thread(browser.until, "document.getElementById('no-write').hidden")
        assert not await asyncio.to_thread(browser.run, "return document.getElementById('go').hidden")
        assert line.records == []
        assert browser.complaints() == []


@pytest.mark.asyncio
async def test_where_a_token_is_wanted_the_page_asks_for_it(browser: Browser, tmp_path: Path) -> None:
    async with shown(browser, tmp_path, secrets={"hmi": digest_of(TOKEN)}) as (line, _):
        await asyncio.to_thread(browser.click, "#point-rows button.name")
        await asyncio.to_thread(browser.type, "#new-value", "3")
        await asyncio.to_thread(browser.press, ENTER, ENTER)
        await says(browser, "#outcome", "token")
        assert line.records == []
        await asyncio.to_thread(browser.type, "#token", TOKEN)
        await asyncio.to_thread(browser.click, "#go")
        await asyncio.to_thread(browser.click, "#go")
        await says(browser, "#outcome", "was written")
        assert line.audit() == [("5/10", "written")]


@pytest.mark.asyncio
async def test_when_the_owner_goes_it_says_so_and_when_it_is_back_all_is_well(browser: Browser, tmp_path: Path) -> None:
    async with page(tmp_path) as of:
        for number in range(2):
            async with served(tmp_path) as line:
                poll(line)
                await shows(of.line)
                if number == 0:
                    await asyncio.to_thread(browser.open, of.url)
                await asyncio.to_thread(browser.until, READY)
                assert await asyncio.to_thread(browser.run, "return document.getElementById('trouble').hidden")
            await asyncio.to_thread(browser.until, "document.documentElement.dataset.state === 'owner away'")
            assert "the values are old" in await asyncio.to_thread(browser.text, "#trouble")


@pytest.mark.parametrize(
    ("width", "height", "phone", "scheme"),
    [(1400, 1000, False, "light"), (1400, 1000, False, "dark"), (390, 844, True, "dark"), (320, 640, True, "light")],
)
@pytest.mark.asyncio
async def test_forty_nodes_fit_any_width_light_and_dark(
    browser: Browser, tmp_path: Path, width: int, height: int, phone: bool, scheme: str
) -> None:
    async with forty(tmp_path), page(tmp_path) as of:
        browser.resize(width, height, phone=phone)
        browser.prefer(scheme)
        await asyncio.to_thread(browser.open, of.url)
        await asyncio.to_thread(browser.until, "document.querySelectorAll('#node-list li').length === 40")
        await asyncio.to_thread(browser.until, "document.querySelectorAll('#point-rows tr.point').length === 80")
        await asyncio.to_thread(
            browser.until, "document.querySelector('#node-list li.down')?.textContent.includes('✕ down')"
        )
        await says(browser, "#health", "1 of 40")
        wide = await asyncio.to_thread(browser.run, "return document.documentElement.scrollWidth")
        assert wide <= width
        ground = await asyncio.to_thread(browser.run, "return getComputedStyle(document.body).backgroundColor")
        assert ground == {"light": "rgb(246, 247, 249)", "dark": "rgb(20, 23, 26)"}[scheme]
        contrast = await asyncio.to_thread(browser.run, LEAST_CONTRAST.read_text())
        assert contrast >= 4.5
        assert browser.complaints() == []


# pages of other sites


@contextlib.contextmanager
def another_site() -> Iterator[str]:
    """A site of somebody else, on this machine."""

    class Site(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<title>evil</title><body>evil")

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.asyncio
async def test_a_page_opened_by_another_site_neither_reads_nor_writes(browser: Browser, tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        with another_site() as site:
            await asyncio.to_thread(browser.open, site)
            outcomes = await asyncio.to_thread(browser.run, ATTACK.read_text(), of.url)
        assert set(outcomes) == {"json", "plain", "post", "read", "script", "socket", "frame"}
        assert set(outcomes.values()) == {"refused"}
        assert line.records == []
        assert of.writes == []


@pytest.mark.asyncio
async def test_a_name_that_was_rebound_to_this_machine_shows_nothing(browser: Browser, tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        rebound = of.url.replace("127.0.0.1", "rebound.example")
        await asyncio.to_thread(browser.open, rebound)
        assert "no such host" in await asyncio.to_thread(browser.text, "body")
        put = "{ method: 'PUT', headers: { 'Content-Type': 'application/json' }, body: '{}' }"
        status = f"return (await fetch('/api/points/axes/5/10', {put})).status"
        assert await asyncio.to_thread(browser.run, status) == 403
        assert line.records == []
