"""The page of the REST API at /docs: every operation of /openapi.json with a form, without anything from elsewhere."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.interfaces.web import PAGE
from busmaster.app.service.permission import digest_of
from tests.app.interfaces.browser import Browser, chromium, needs_chromium
from tests.app.interfaces.lines import page, poll, shows
from tests.app.interfaces.test_page_sizes import ACCESSIBILITY, PHONE, axe
from tests.app.service.lines import served

TOKEN = "0123456789abcdef"
SCHEMA = json.loads((PAGE / "openapi.json").read_text())
LISTED = """
return [...document.querySelectorAll(".operation > summary")].map(
  (one) => [one.querySelector(".method").textContent, one.querySelector("code").textContent]);
"""
FILLED = "document.querySelector('#op-point-key')?.value"
LOADED = """
const hosts = performance.getEntriesByType("resource").map((one) => new URL(one.name).host);
return hosts.filter((one) => one !== location.host);
"""
TEXTS_OF = "return [...document.querySelectorAll(`#${given[0]} :is(.status, pre)`)].map((one) => one.textContent)"


def test_no_file_of_the_pages_names_another_host() -> None:
    """A name space of SVG is a name alone."""
    for file in PAGE.iterdir():
        found = re.findall(r"https?://[\w.]+", file.read_text())
        assert set(found) <= {"http://www.w3.org"}, file.name


@pytest.mark.asyncio
async def test_it_is_served_with_the_policy_of_the_pages(tmp_path: Path) -> None:
    async with page(tmp_path) as of:
        docs, first = await of.client.get("/docs"), await of.client.get("/")
        assert docs.headers["content-type"] == "text/html; charset=utf-8"
        assert docs.headers["content-security-policy"] == first.headers["content-security-policy"]
        for path in re.findall(r'(?:src|href)="(/[^"]+)"', docs.text):
            assert (await of.client.get(path)).status_code == 200
        assert 'href="/docs"' in first.text


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("chromium"), hosts="MAP * ~NOTFOUND, EXCLUDE 127.0.0.1") as browser:
        yield browser


@pytest.fixture
def browser(window: Browser) -> Browser:
    window.open("about:blank")
    window.resize(1400, 1000)
    window.prefer("light")
    window.complaints()
    return window


async def sent(browser: Browser, operation: str) -> list[str]:
    """Press the button of an operation: the texts below it, once there are some."""
    await asyncio.to_thread(browser.click, f"#{operation} .go")
    await asyncio.to_thread(browser.until, "document.querySelector(`#${given[0]} .status`)?.textContent", operation)
    said: Any = await asyncio.to_thread(browser.run, TEXTS_OF, operation)
    return list(said)


@needs_chromium()
@pytest.mark.slow
@pytest.mark.asyncio
async def test_it_lists_every_operation_and_sends_what_its_form_says(browser: Browser, tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path, secrets={"hmi": digest_of(TOKEN)}) as of:
        poll(line)
        await shows(of.line)
        await asyncio.to_thread(browser.open, f"{of.url}docs")
        await asyncio.to_thread(browser.until, FILLED)
        listed = {tuple(one) for one in await asyncio.to_thread(browser.run, LISTED)}
        methods = {
            (method, path) for path, item in SCHEMA["paths"].items() for method in item if method != "parameters"
        }
        assert listed == {(method.upper(), path) for method, path in methods}
        for operation in ("line", "nodes", "groups", "events", "points", "point"):
            await asyncio.to_thread(browser.run, f"document.getElementById('op-{operation}').open = true")
            await asyncio.to_thread(browser.click, f"#op-{operation} .go")
            await asyncio.to_thread(
                browser.until, f"document.querySelector('#op-{operation} .status')?.textContent.startsWith('200')"
            )
        [body, command] = (await asyncio.to_thread(browser.run, TEXTS_OF, "op-point"))[1:]
        assert json.loads(body)["key"] == "5/10"
        assert command == f"curl '{of.url}api/points/axes/5/10'"
        assert await asyncio.to_thread(browser.run, LOADED) == []
        assert browser.complaints() == []


@needs_chromium()
@pytest.mark.slow
@pytest.mark.asyncio
async def test_a_write_is_sent_after_it_is_confirmed_and_with_the_token(browser: Browser, tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path, secrets={"hmi": digest_of(TOKEN)}) as of:
        poll(line)
        await shows(of.line)
        await asyncio.to_thread(browser.open, f"{of.url}docs#op-write")
        await asyncio.to_thread(browser.until, f"{FILLED} && document.getElementById('op-write').open")
        assert await sent(browser, "op-write") == ["Enter a body."]
        await asyncio.to_thread(browser.type, "#op-write-body", '{"value": 7}')
        assert await sent(browser, "op-write") == ["This changes the line. Send it?"]
        assert line.records == []
        await asyncio.to_thread(browser.type, "#op-write-body", " ")  # what is changed is confirmed anew
        assert await asyncio.to_thread(browser.text, "#op-write .go") == "Send PUT…"
        for token, status in (("", "401"), (TOKEN, "200")):
            await asyncio.to_thread(browser.type, "#token", token)
            for _ in range(2):
                await asyncio.to_thread(browser.click, "#op-write .go")
            await asyncio.to_thread(
                browser.until, "document.querySelector('#op-write .status').textContent.startsWith(given[0])", status
            )
        assert line.audit() == [("5/10", "written")]
        [body, command] = (await asyncio.to_thread(browser.run, TEXTS_OF, "op-write"))[1:]
        assert json.loads(body) == {"written": 7}
        assert TOKEN not in command


@needs_chromium()
@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [(360, 740), (768, 1024), (1366, 768)])
@pytest.mark.asyncio
async def test_nothing_is_cut_and_axe_finds_no_violation(
    browser: Browser, tmp_path: Path, width: int, height: int, scheme: str
) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        browser.resize(width, height, phone=width < PHONE)
        browser.prefer(scheme)
        await asyncio.to_thread(browser.open, f"{of.url}docs")
        await asyncio.to_thread(browser.until, FILLED)
        await asyncio.to_thread(browser.run, "for (const one of document.querySelectorAll('details')) one.open = true")
        assert await asyncio.to_thread(browser.run, "return document.documentElement.scrollWidth <= innerWidth")
        if (text := axe()) is not None:
            assert await asyncio.to_thread(browser.run, f"{text}\n{ACCESSIBILITY}") == []
