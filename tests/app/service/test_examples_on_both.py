"""Each example that takes a bus runs on a `Bus`, and on a `RemoteBus` through a Unix socket, unchanged."""

from __future__ import annotations

import ast
import asyncio
import importlib.util
import inspect
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from types import ModuleType
from typing import TypeAlias

import pytest
from anyio.from_thread import start_blocking_portal

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MicroFlexDrive, Service, connect
from busmaster.emulator.line import Line
from busmaster.errors import WriteUnconfirmed
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from tests.docs.pages import ROOT
from tests.patience import PATIENCE
from tests.tiers import one_by_default

OWN_THEIR_LINE = {
    "supervisory_service": "shows the state of the line and the health of its nodes, which only their owner has",
}
"""Examples that run on a `Bus` alone, and why."""
BY_THEMSELVES = {"from_a_thread", "testing_your_application"}
"""Those whose part that uses the bus is not `main(bus)`."""


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


TRIES = 3
"""On a busy machine a reply may be so late that a write is unconfirmed (R4), and no example writes again by itself."""
NAMES = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
PROGRAMS = sorted(
    (name for name in NAMES if name not in OWN_THEIR_LINE and name not in BY_THEMSELVES),
    key=lambda name: (not name.endswith("hello"), name),  # the first runs by default: a quick one
)


@asynccontextmanager
async def near(port: Endpoint, folder: Path) -> AsyncIterator[BusLike]:
    async with Bus(port) as bus:
        yield bus


@asynccontextmanager
async def far(port: Endpoint, folder: Path) -> AsyncIterator[BusLike]:
    path = folder / "example.sock"
    async with Bus(port) as bus, Service(bus, path=path), connect(f"unix:{path}") as remote:
        yield remote


Opens: TypeAlias = Callable[[Endpoint, Path], AbstractAsyncContextManager[BusLike]]
BOTH: list[Opens] = [near, far]


def test_every_example_takes_a_bus_like_or_says_why_not() -> None:
    for name in NAMES:
        tree = ast.parse((ROOT / "examples" / f"{name}.py").read_text())
        arguments = [node for node in ast.walk(tree) if isinstance(node, ast.arg)]
        annotations = {ast.unparse(one.annotation) for one in arguments if one.annotation is not None}
        assert ("BusLike" in annotations) == (name not in OWN_THEIR_LINE), name
        assert "Bus" not in annotations, name


@pytest.mark.parametrize("name", one_by_default(PROGRAMS))
def test_an_example_does_as_much_on_a_remote_bus_as_on_a_bus(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = module(name)
    assert inspect.signature(example.main).parameters["bus"].annotation in ("BusLike", BusLike)

    async def run(opened: Opens) -> None:
        async with asyncio.timeout(PATIENCE), opened(example.emulated(), tmp_path) as bus:
            await example.main(bus)

    printed = []
    for opened in BOTH:
        for left in reversed(range(TRIES)):
            try:
                asyncio.run(run(opened))
            except WriteUnconfirmed:
                capsys.readouterr()
                if not left:
                    raise
            else:
                break
        printed.append(capsys.readouterr().out.splitlines())
    assert len(printed[0]) == len(printed[1]) > 0


@pytest.mark.parametrize("opened", BOTH)
def test_the_example_that_calls_from_a_thread_runs_on_both(
    opened: Opens, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = module("from_a_thread")
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(opened(example.emulated(), tmp_path)) as bus,
    ):
        example.main(portal, bus)
    assert capsys.readouterr().out.startswith("Comms(1) is 12.5\n")


@pytest.mark.parametrize("opened", BOTH)
def test_the_application_that_is_tested_in_virtual_time_runs_on_both(opened: Opens, tmp_path: Path) -> None:
    guard = module("testing_your_application").guard
    emulated = EmulatedMicroFlex(7)

    async def run() -> None:
        port = MemoryPort(Line(MicroFlexDrive.profile.line, [emulated]))
        async with asyncio.timeout(PATIENCE), opened(port, tmp_path) as bus:
            drive = MicroFlexDrive(bus, 7)
            await drive.enable()
            assert emulated.enabled
            await guard(bus, drive, limit=-1000.0)
            assert not emulated.enabled

    asyncio.run(run())
