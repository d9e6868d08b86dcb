"""pytest fixtures for testing an application. In a conftest.py:

pytest_plugins = ["busmaster.testing.fixtures"]
"""

from __future__ import annotations

import random
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, Protocol

import pytest

from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.ext import find, make_device
from busmaster.testing.bench import BenchReport, bench
from busmaster.testing.virtual_time import run_in_virtual_time


class LineFactory(Protocol):
    """Creates an emulated line with devices of one protocol. Use it with a MemoryPort or `serve_pty`.

    `delay`: reply delay of the devices. `faults`: faults of each device ("lost=0.1"). `seed`: for all randomness on the
    line.
    """

    def __call__(
        self,
        protocol: str,
        nodes: Iterable[int] = (1,),
        *,
        delay: Delay | None = None,
        faults: Iterable[str] = (),
        seed: int = 0,
        **options: Any,
    ) -> Line: ...


@pytest.fixture
def virtual_time() -> Callable[[Coroutine[Any, Any, Any]], Any]:
    """Run a coroutine to its end in virtual time and return its result: `virtual_time(main())`."""
    return run_in_virtual_time


@pytest.fixture
def emulated_line() -> LineFactory:
    """Make emulated lines: `emulated_line("hcp2", range(1, 9))`. Further options are those of `Line`."""

    def make(
        protocol: str,
        nodes: Iterable[int] = (1,),
        *,
        delay: Delay | None = None,
        faults: Iterable[str] = (),
        seed: int = 0,
        **options: Any,
    ) -> Line:
        devices = [make_device(protocol, node, delay=delay) for node in nodes]
        settings = tuple(faults)
        for device in devices:
            device.faults = Faults.parse(settings)
        return Line(find(protocol).profile.line, devices, chance=random.Random(seed), **options)

    return make


@pytest.fixture
def latency_bench() -> Callable[..., BenchReport]:
    """Measure an emulated line, and hold it against a budget: `latency_bench("hcp2", range(1, 33)).check("p99=20")`.

    The arguments are those of `busmaster.testing.bench.bench`.
    """
    return bench
