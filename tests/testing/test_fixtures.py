"""The pytest fixtures that busmaster ships, used as an application's tests would use them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, NoReply
from busmaster.emulator.memory import MemoryPort
from busmaster.testing.fixtures import LineFactory, emulated_line, virtual_time

__all__ = ["emulated_line", "virtual_time"]


def test_an_application_is_tested_in_virtual_time(
    virtual_time: Callable[[Coroutine[Any, Any, float]], float], emulated_line: LineFactory
) -> None:
    async def application() -> float:
        async with Bus(MemoryPort(emulated_line("hcp2", [5]))) as bus:
            axis = Hcp2Controller(bus, 5)
            await axis.write(1, 123.456)
            await asyncio.sleep(3600)
            return await axis.read(1)

    assert virtual_time(application()) == 123.456


def test_a_device_may_have_faults(
    virtual_time: Callable[[Coroutine[Any, Any, None]], None], emulated_line: LineFactory
) -> None:
    async def application() -> None:
        async with Bus(MemoryPort(emulated_line("hcp2", [5], faults=["dead=1"]))) as bus:
            with pytest.raises(NoReply):
                await Hcp2Controller(bus, 5).read(1)

    virtual_time(application())
