"""Devices by the name of their protocol."""

from __future__ import annotations

import pytest

from busmaster.emulator.device import Delay
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.device import HCP, HostCommsDevice
from busmaster.registry import find, kinds, make_device
from tests.emulator.lines import ask, line_of


@pytest.mark.parametrize("protocol", list(kinds()))
def test_every_protocol_has_a_device(protocol: str) -> None:
    address = find(protocol).profile.addresses[-1]
    device = make_device(protocol, address, delay=Delay(0.01))
    assert device.address == address
    assert device.delay == Delay(0.01)
    line_of(device)


def test_hcp_and_hcp2_controllers_differ_in_framing() -> None:
    device = make_device("hcp", 2)
    assert isinstance(device, HostCommsDevice)
    assert device.framing is HCP


def test_something_moves_on_a_lively_device() -> None:
    for protocol, request in (
        ("hcp", "04 32 32 02 31 31 05"),  # Comms(11)
        ("hcp2", "07 30 32 02 36 34 05 07"),  # Comms(100), the position of axis 0
        ("microflex", "07 30 32 02 36 34 05 07"),
        ("msc", "02 02 00 08 00 00 44 52 45 41 44 2C 07 D0 02 6D"),  # DREAD 2000, what its program counts
        ("mentor", "04 30 30 32 32 30 33 30 32 05"),  # 03.02, the speed feedback
        ("ct-ansi", "04 31 31 34 34 30 33 30 32 05"),
        ("dc104", "02 AA 01 AB"),
        ("modbus", "02 03 00 00 00 01 84 39"),  # holding register 0
    ):
        address = 14 if protocol == "ct-ansi" else 2
        line = line_of(make_device(protocol, address, lively=True))
        assert len({ask(line, request, now) for now in range(1000, 1005)}) > 3
        still = line_of(make_device(protocol, address))
        assert len({ask(still, request, now) for now in range(1000, 1005)}) == 1


def test_the_oracle_answers_in_their_place() -> None:
    line = line_of(make_device("microflex", 2, traceable=TraceableMemory(2)))
    assert bytes.fromhex(ask(line, "07 30 32 02 36 34 05 07"))[3:-2] == str(traceable_value(2, 100, 0)).encode()


def test_a_protocol_that_does_not_exist_is_refused() -> None:
    with pytest.raises(InvalidCommand, match="no such protocol 'profibus'"):
        make_device("profibus", 1)
