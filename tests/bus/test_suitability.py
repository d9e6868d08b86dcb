"""Which protocols may be on one line, and at which rate: refused, and warned about, when a handle is made."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import product

import pytest

from busmaster import Bus, Endpoint, InvalidCommand, LineSettings, MemoryPort, Rfc2217Port, SerialPort, TcpPort
from busmaster.emulator.line import Line
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from busmaster.registry import find, kinds, protocols

SHARED = {frozenset(("hcp", "hcp2")), frozenset(("mentor", "ct-ansi"))}


@pytest.fixture
def bus() -> Bus:
    """Not entered: what it would carry is known before that."""
    return Bus(MemoryPort(Line(LineSettings(9600))))


@pytest.mark.parametrize(("first", "second"), list(product(kinds(), repeat=2)))
def test_only_protocols_that_know_each_other_share_a_bus(bus: Bus, first: str, second: str) -> None:
    one, other = find(first), find(second)
    one.handle(bus, one.profile.addresses[-1])
    if one.protocol is other.protocol or frozenset((one.profile.name, other.profile.name)) in SHARED:
        other.handle(bus, other.profile.addresses[-1])
        return
    with pytest.raises(InvalidCommand, match=f"{other.profile.name} and {one.profile.name} nodes cannot share a line"):
        other.handle(bus, other.profile.addresses[-1])
    assert [node.profile.name for node in bus.nodes] == [one.profile.name]


def test_it_is_enough_that_the_newer_protocol_knows_the_older() -> None:
    """A protocol that a package brings cannot be named by those that were there before."""
    newer = replace(msc.PROFILE, name="newer", shares_line_with=frozenset(("mentor",)))
    assert newer.may_share_with(mentor.PROFILE)
    assert mentor.PROFILE.may_share_with(newer)
    assert not newer.may_share_with(dc104.PROFILE)


def test_a_third_protocol_must_go_with_both() -> None:
    bus = Bus(MemoryPort(Line(LineSettings(9600))))
    third = replace(mentor.PROFILE, name="third", shares_line_with=frozenset(("hcp",)))
    bus.node(find("hcp").profile, 1)
    bus.node(find("hcp2").profile, 1)
    with pytest.raises(InvalidCommand, match="third and hcp2 nodes cannot share"):
        bus.node(third, 1)


def test_two_documents_give_one_rate_and_no_other() -> None:
    fixed = {protocol.name: protocol.profile.line.baudrate for protocol in protocols() if protocol.profile.fixed_rate}
    assert fixed == {"msc": 9600, "dc104": 19200}


@pytest.mark.parametrize("endpoint", [SerialPort("/dev/ttyS0", baudrate=19200), TcpPort("10.0.0.5", 1, baudrate=19200)])
def test_another_rate_is_warned_about_when_the_first_handle_is_made(endpoint: Endpoint) -> None:
    bus = Bus(endpoint)
    with pytest.warns(UserWarning, match=r": MSC nodes support only 9600 baud, not 19200$") as told:
        bus.node(msc.PROFILE, 1)
    bus.node(msc.PROFILE, 2)  # not said again: it would be an error here
    assert len(told) == 1
    assert str(told[0].message).startswith(f"{endpoint.name}: ")


@pytest.mark.parametrize(
    "endpoint",
    [
        SerialPort("/dev/ttyS0", baudrate=9600),
        TcpPort("10.0.0.5", 1, baudrate=9600),
        TcpPort("10.0.0.5", 1),
        MemoryPort(Line(LineSettings(19200))),
    ],
    ids=["serial", "tcp", "tcp, rate unknown", "memory"],
)
def test_the_right_rate_an_unknown_one_and_a_line_in_memory_are_not(endpoint: Endpoint) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Bus(endpoint).node(msc.PROFILE, 1)


def test_a_protocol_with_a_choice_of_rates_takes_any() -> None:
    assert not find("hcp2").profile.wrong_rate(9600)
    assert not mentor.PROFILE.wrong_rate(4800)


def test_another_framing_on_a_serial_port_is_warned_about() -> None:
    with pytest.warns(UserWarning, match=r"mentor is meant for 7E1, but server:4001 is 8N1"):
        Bus(Rfc2217Port("server", 4001, baudrate=9600)).node(mentor.PROFILE, 14)
    with pytest.warns(UserWarning, match=r"mentor is meant for 7E1, but /dev/ttyS0 is 8N1"):
        Bus(SerialPort("/dev/ttyS0", baudrate=9600)).node(mentor.PROFILE, 14)


def test_a_framing_that_the_documents_name_beside_the_usual_one_is_accepted() -> None:
    several = replace(mentor.PROFILE, other_lines=(LineSettings(9600), LineSettings(19200)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Bus(SerialPort("/dev/ttyS0", baudrate=9600)).node(several, 14)
    with pytest.warns(UserWarning, match="mentor is meant for 7E1 or 8N1, but /dev/ttyS0 is 8N2"):
        Bus(SerialPort("/dev/ttyS0", baudrate=9600, stopbits=2)).node(several, 14)


def test_the_framing_behind_a_port_of_raw_tcp_is_that_of_the_serial_server() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Bus(TcpPort("10.0.0.5", 1, baudrate=9600)).node(mentor.PROFILE, 14)
