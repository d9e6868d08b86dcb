"""A `run` that ends while it does something else: the safe state is sent, and waits for nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import anyio
import pytest

from busmaster.app.cli.arguments import View
from busmaster.app.cli.hangups import Hangups
from busmaster.app.cli.run import Running
from busmaster.app.config import LineFile, load
from busmaster.app.line import ConfiguredLine
from busmaster.emulator.line import Line
from busmaster.protocols._comms.mint import EmulatedMint
from tests.app.cli.conftest import serve
from tests.patience import PATIENCE

TEXT = """
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
[groups.fast]
period = 0.05
points = ["winder/10"]
[safe]
within = 30.0
repeatable = ["winder/10"]
writes = { "winder/10" = 1.5 }
[service]
enabled = false
"""


async def comes_true(fact: Callable[[], bool]) -> bool:
    """Whether it does before patience is over."""
    with anyio.move_on_after(PATIENCE, shield=True):
        while not fact():  # noqa: ASYNC110  another thread makes it true
            await anyio.sleep(0.01)
        return True
    return False


def test_the_safe_state_is_sent_while_a_file_that_is_read_again_still_waits_for_its_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "line.toml"
    hangups, replacing, replaced = Hangups(), anyio.Event(), anyio.Event()

    async def take(_: LineFile, _secrets: Mapping[str, bytes]) -> None:
        """As with an output that hangs: nothing ends it, a cancel neither."""
        replacing.set()
        with anyio.CancelScope(shield=True):
            await replaced.wait()

    async def left_safely() -> bool:
        line = ConfiguredLine(load(path), wait_for_port=True)
        monkeypatch.setattr(line, "take", take)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(Running(line, str(path), View(silent=True), hangups, None).run)
            hangups._receive(0, None)
            await replacing.wait()
            tasks.cancel_scope.cancel()
            try:
                came = await comes_true(lambda: winder.call(held) == 1.5)
            finally:
                replaced.set()
        return came

    with serve("hcp2", 1) as winder:
        path.write_text(TEXT.replace("PORT", winder.path))
        assert anyio.run(left_safely)


def test_the_safe_state_is_sent_where_serving_the_line_to_others_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "line.toml"

    def served(*_: object, **__: object) -> None:
        raise OSError("no more sockets")

    monkeypatch.setattr("busmaster.app.cli.run.served", served)
    with serve("hcp2", 1) as winder:
        path.write_text(TEXT.replace("PORT", winder.path))
        line = ConfiguredLine(load(path), wait_for_port=True)
        with pytest.raises(OSError, match="no more sockets"):
            anyio.run(Running(line, str(path), View(silent=True), Hangups(), None).run)
        assert winder.call(held) == 1.5


def held(line: Line, now: float) -> float | None:
    """Return what the drive itself says that its element 10 holds."""
    drive = line.device(1)
    assert isinstance(drive, EmulatedMint)
    return drive.read_element(10, now)
