"""The pictures of the README, taken anew: `python -m tests.app.interfaces.pictures`. It needs Chromium with its driver.

The line of `examples/line.toml`, emulated, served and shown in a browser, light and dark, a minute after its start.
"""

from __future__ import annotations

import base64
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from tests.app.interfaces.browser import Browser, chromium

ROOT = Path(__file__).parents[3]
PICTURES = ROOT / "docs" / "pictures"
BUSMASTER = (sys.executable, "-m", "busmaster")
WIDTH, HEIGHT = 1300, 780
SECONDS = 30.0
"""So much of its past the trends show."""
EARLIER, EXCHANGES_BACK = "\ue012", 3
QUALITY = 80


def main() -> None:
    """Start the programs, take the pictures, and end the programs."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        (folder / "slitter.toml").write_text((ROOT / "examples" / "line.toml").read_text())
        environment = os.environ | {"PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": name}

        def start(*arguments: str) -> subprocess.Popen[str]:
            command = (*BUSMASTER, *arguments)
            process = subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        def told(process: subprocess.Popen[str], words: str) -> str:
            assert process.stderr is not None
            return next(line for line in process.stderr if words in line)

        start("emulate", "slitter.toml")
        told(start("serve", "slitter.toml"), "is served at")
        page = told(start("web", "slitter", "--bind", "127.0.0.1:8499"), "the page is at")
        time.sleep(SECONDS)
        with chromium(folder) as browser:
            take(browser, page.split()[-1])


def take(browser: Browser, url: str) -> None:
    """Open the page, look at an exchange, and take a picture of each colour scheme."""
    PICTURES.mkdir(exist_ok=True)
    browser.resize(WIDTH, HEIGHT)
    browser.open(url)
    browser.until("document.querySelector('#point-rows td.value')?.textContent")
    time.sleep(SECONDS)
    browser.run("document.querySelector('#wire-canvas').focus()")
    for _ in range(EXCHANGES_BACK):
        browser.press(EARLIER)
    for scheme in ("light", "dark"):
        browser.prefer(scheme)
        browser.until("true")  # drawn once more
        picture = browser.command("Page.captureScreenshot", format="webp", quality=QUALITY)
        (PICTURES / f"page-{scheme}.webp").write_bytes(base64.b64decode(picture["data"]))


if __name__ == "__main__":
    main()
