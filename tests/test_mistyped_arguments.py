"""What a user mistypes is told at once, in words, and nothing is sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from busmaster import Bus, Hcp2Controller, InvalidCommand, MemoryPort, SerialPort, TcpPort
from busmaster.emulator.line import Line
from busmaster.profile import LineSettings
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing import run_in_virtual_time


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: Bus(cast("Any", "/dev/ttyUSB0")),
        lambda: TcpPort("host", cast("Any", "x")),
        lambda: SerialPort("/dev/ttyUSB0", baudrate=cast("Any", "57600")),
    ],
)
def test_a_wrong_kind_of_value_for_a_port_is_refused_in_words(mistake: Callable[[], object]) -> None:
    with pytest.raises(InvalidCommand):
        mistake()


def test_what_is_no_command_and_no_address_is_refused_before_anything_is_sent() -> None:
    async def main() -> None:
        async with Bus(MemoryPort(Line(LineSettings(57600), [make_device("hcp2", 1)]))) as bus:
            node = Hcp2Controller(bus, 1).node
            with pytest.raises(InvalidCommand, match="no command"):
                await node.request(cast("Any", "read"))
            with pytest.raises(InvalidCommand):
                bus.node(hcp2.PROFILE, True)
            assert bus.statistics().exchanges == 0

    run_in_virtual_time(main())
