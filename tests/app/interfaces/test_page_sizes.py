"""The page at the sizes of phones, tablets and screens, in calm and in failure: all that matters can be seen."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.app.interfaces.browser import Browser, chromium, needs_chromium
from tests.app.interfaces.plants import CALM, DEAD_DRIVE, NODE_DOWN, SITUATIONS, open_page, plant

pytestmark = [needs_chromium(), pytest.mark.slow]

SIZES = ((360, 740), (768, 1024), (1280, 800), (1366, 768), (1440, 900), (1920, 1080))
PHONE = 500
TEXTS = "return [...document.querySelectorAll(`#point-rows ${given[0]}`)].map((one) => one.innerText)"
OVERFLOW = Path(__file__).with_name("overflow.js").read_text()
LARGEST_SHIFT = 0.1
SHIFTED = """
const entries = await new Promise((done) => {
  const told = (list) => done(list.getEntries());
  new PerformanceObserver(told).observe({ type: "layout-shift", buffered: true });
  setTimeout(() => done([]), 500); // nothing is told where nothing has moved
});
return entries.reduce((sum, one) => sum + one.value, 0);
"""
"""How much of the page has moved since it was opened, as browsers calculate it: 1 is all of it by its own height."""
ACCESSIBILITY = """
const { violations } = await axe.run({ resultTypes: ["violations"] });
return violations.flatMap(({ id, help, nodes }) => nodes.map((node) => `${id}: ${help}: ${node.html.slice(0, 120)}: ${
    node.any.map((one) => one.message).join("; ").slice(0, 200)}`));
"""


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("chromium")) as browser:
        yield browser


@pytest.fixture(params=SITUATIONS, scope="module")
def situation(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def url(situation: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with plant(tmp_path_factory.mktemp("plant"), situation) as address:
        yield address


def axe() -> str | None:
    """The text of axe-core: that of the variable AXE_CORE, else that of the package of the test extra, else none."""
    if path := os.environ.get("AXE_CORE"):
        return Path(path).read_text()
    spec = importlib.util.find_spec("axe_core_python")
    if spec is None or spec.origin is None:
        return None
    return Path(spec.origin).with_name("axe.min.js").read_text()


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_nothing_is_cut_or_needs_scrolling_to_the_side(
    window: Browser, url: str, situation: str, width: int, height: int
) -> None:
    window.resize(width, height, phone=width < PHONE)
    open_page(window, url, situation)
    assert window.run(OVERFLOW) == []
    qualities, reasons = window.run(TEXTS, "td.quality"), window.run(TEXTS, "tr.reason")
    bad = [quality for quality in qualities if "bad" in quality]
    if situation == CALM:
        assert (bad, reasons) == ([], [])
        assert qualities.count("▲ bit set") == qualities.count("▼ bit clear") == 1
        assert window.run(SHIFTED) < LARGEST_SHIFT
    elif situation == NODE_DOWN:
        assert len(bad) == 3, f"of {DEAD_DRIVE} alone"
        [reason] = reasons  # once for the three, and not in the table's columns
        assert "not responding" in reason
        assert "the next 2 points" in reason
    else:
        assert len(bad) == len(qualities)
        texts = window.run(TEXTS, "td.value")
        assert "–" not in texts, "the last values stay, in a page that was opened later too"
        assert window.run("return document.getElementById('trouble').getBoundingClientRect().bottom <= innerHeight")


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_dialog_of_a_run_of_registers_fits(
    window: Browser, url: str, situation: str, width: int, height: int
) -> None:
    window.resize(width, height, phone=width < PHONE)
    open_page(window, url, situation)
    recipe = (
        "[...document.querySelectorAll('#point-rows button.name')].find((one) => one.textContent.includes('recipe'))"
    )
    window.run(f"{recipe}.click()")
    window.until("document.getElementById('point-facts').children.length > 4")
    box = "document.getElementById('point')"
    inside = f"const box = {box}.getBoundingClientRect();"
    assert window.run(f"{inside} return box.left >= 0 && box.right <= innerWidth && box.bottom <= innerHeight")
    assert window.run(f"return {box}.scrollWidth <= {box}.clientWidth")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [SIZES[0], SIZES[3]])
def test_axe_finds_no_violation(
    window: Browser, url: str, situation: str, width: int, height: int, scheme: str
) -> None:
    text = axe()
    if text is None:
        pytest.skip("needs axe-core: pip install axe-core-python, or AXE_CORE=PATH of another axe.min.js")
    window.resize(width, height, phone=width < PHONE)
    window.prefer(scheme)
    open_page(window, url, situation)
    try:
        assert window.run(f"{text}\n{ACCESSIBILITY}") == []
    finally:
        window.prefer("light")
