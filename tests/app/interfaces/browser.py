"""A real Chromium, by the WebDriver protocol: just what the tests of the page need of it."""

from __future__ import annotations

import base64
import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest

from tests.patience import PATIENCE

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""What WebDriver calls a reference to an element."""


def needs_chromium() -> pytest.MarkDecorator:
    """Skip, with a reason, where there is no Chromium with its driver."""
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs {' and '.join(missing)}: apt-get install chromium-driver")


class Browser:
    """One window."""

    def __init__(self, client: httpx.Client, session: str) -> None:
        self._client = client
        self._path = f"/session/{session}"

    def _ask(self, path: str, **params: Any) -> Any:
        answer = self._client.post(self._path + path, json=params).json()["value"]
        if isinstance(answer, dict) and "error" in answer:
            raise AssertionError(f"{answer['error']}: {answer['message']}")
        return answer

    def open(self, url: str) -> None:
        self._ask("/url", url=url)

    def run(self, script: str, *arguments: Any) -> Any:
        """What a function of this body returns in the page, where it may await."""
        body = (
            f"const done = arguments[arguments.length - 1];(async (...given) => {{{script}}})(...arguments).then(done)"
        )
        return self._ask("/execute/async", script=body, args=list(arguments))

    def until(self, fact: str, *arguments: Any) -> Any:
        """What an expression of the page is once it is true: it is looked at with each frame that is drawn."""
        wait = "const next = () => new Promise((go) => requestAnimationFrame(go)); let found;"
        return self.run(f"{wait} while (!(found = {fact})) await next(); return found;", *arguments)

    def element(self, selector: str) -> str:
        found: str = self._ask("/element", using="css selector", value=selector)[ELEMENT]
        return found

    def click(self, selector: str) -> None:
        self._ask(f"/element/{self.element(selector)}/click")

    def type(self, selector: str, text: str) -> None:
        self._ask(f"/element/{self.element(selector)}/value", text=text)

    def press(self, *keys: str) -> None:
        """Press keys wherever the focus is."""
        strokes = [{"type": kind, "value": key} for key in keys for kind in ("keyDown", "keyUp")]
        self._ask("/actions", actions=[{"type": "key", "id": "keyboard", "actions": strokes}])

    def point_at(self, selector: str, x: int, y: int) -> None:
        """Move the pointer to so many pixels from an element's middle."""
        origin = {ELEMENT: self.element(selector)}
        move = {"type": "pointerMove", "duration": 0, "x": x, "y": y, "origin": origin}
        self._ask("/actions", actions=[{"type": "pointer", "id": "mouse", "actions": [move]}])

    def text(self, selector: str) -> str:
        return str(self.run("return document.querySelector(given[0]).textContent", selector))

    def resize(self, width: int, height: int, *, phone: bool = False) -> None:
        """Let the page have this many pixels."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 2 if phone else 1, "mobile": phone}
        self.command("Emulation.setDeviceMetricsOverride", **metrics)

    def prefer(self, scheme: str) -> None:
        """Have the page light or dark."""
        self.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def command(self, name: str, **params: Any) -> Any:
        """Give a command of Chromium's own."""
        return self._ask("/goog/cdp/execute", cmd=name, params=params)

    def picture(self, path: Path) -> None:
        answer = self._client.get(f"{self._path}/screenshot").json()["value"]
        path.write_bytes(base64.b64decode(answer))

    def complaints(self) -> list[str]:
        """What the page has complained of since this was asked before: its policy's refusals, its scripts' errors."""
        return [entry["message"] for entry in self._ask("/se/log", type="browser")]


@contextlib.contextmanager
def chromium(folder: Path, *, hosts: str = "") -> Iterator[Browser]:
    """A Chromium with a profile of its own in `folder`; `hosts` are rules of where names lead."""
    log = folder / "chromedriver.log"
    with log.open("wb") as output:
        driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=output, text=True)
    try:
        assert driver.stdout is not None
        port = ""
        while not port:
            said = driver.stdout.readline()
            assert said, log.read_text()
            port = said.partition("on port ")[2].strip(" .\n") if "successfully on port" in said else ""
        arguments = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--no-first-run"]
        arguments += [f"--user-data-dir={folder / 'profile'}", f"--host-resolver-rules={hosts}"]
        wanted = {"goog:chromeOptions": {"args": arguments}, "goog:loggingPrefs": {"browser": "ALL"}}
        wanted |= {"timeouts": {"script": int(PATIENCE * 1000)}}
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=PATIENCE, trust_env=False) as client:
            answer = client.post("/session", json={"capabilities": {"alwaysMatch": wanted}}).json()["value"]
            assert "sessionId" in answer, answer
            try:
                yield Browser(client, answer["sessionId"])
            finally:
                client.delete(f"/session/{answer['sessionId']}")
    finally:
        driver.terminate()
        driver.wait(PATIENCE)
        if driver.stdout is not None:
            driver.stdout.close()
