"""What the registry says of each protocol."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import json
import re
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster import Bus, MemoryPort
from busmaster.contract.exchange import Command, FrameError
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.errors import InvalidCommand, Refused
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.microflex import CommandWord
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.registry import (
    NodeKind,
    Protocol,
    device_of,
    everywhere,
    find,
    kinds,
    make_device,
    nowhere,
    protocols,
)
from busmaster.registry.protocol import usual_width
from tests.patience import PATIENCE
from tests.tiers import one_by_default

every_kind = pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
every_protocol = pytest.mark.parametrize("protocol", protocols(), ids=lambda protocol: protocol.name)


@every_kind
def test_a_kind_of_node_has_a_handle_and_a_device_that_speak_its_protocol(kind: NodeKind) -> None:
    assert kind.handle.profile is kind.profile
    assert kind.profile == kind.protocol.profile
    assert kind in kind.protocol.kinds
    address = kind.profile.addresses[-1]
    device = make_device(kind.name, address, delay=Delay(0.01))
    assert type(device).__name__.startswith("Emulated")
    request = kind.profile.probe.open(address, kind.profile.timings).request
    assert any(request.startswith(route) for route in device.routes)
    assert kind.items


@every_kind
def test_what_the_documents_say_of_items_is_what_the_handle_does(kind: NodeKind) -> None:
    """A range stands for its first and its last."""
    assert kind.documented
    handle = kind.handle(Bus(MemoryPort(Line(kind.profile.line))), kind.profile.addresses[-1])
    for item in kind.documented:
        assert item.meaning
        for name in (re.sub(r"(\d+)-\d+", r"\1", item.item), re.sub(r"\d+-(\d+)", r"\1", item.item)):
            point = handle.point(name)
            assert point.writable is (item.access != "read")
            assert point.unit == item.unit
    names = [item.item for item in kind.documented]
    assert len(set(names)) == len(names)
    assert set(handle.items()) <= set(names)
    assert set(handle._names_of_items().values()) <= set(names)


def test_every_protocol_goes_by_a_name_of_its_own() -> None:
    assert [protocol.name for protocol in protocols()] == sorted({protocol.name for protocol in protocols()})
    assert list(kinds()) == sorted(kinds())
    assert find("microflex").protocol is find("hcp2").protocol


def test_who_may_share_a_line_is_said_by_both() -> None:
    by_name = {protocol.name: protocol for protocol in protocols()}
    for protocol in protocols():
        for other in protocol.profile.shares_line_with:
            assert protocol.name in by_name[other].profile.shares_line_with


def test_a_protocol_that_does_not_exist_is_refused_with_the_nearest_or_those_that_do() -> None:
    with pytest.raises(InvalidCommand, match=r"no such protocol 'hcp3'; did you mean 'hcp'\?"):
        find("hcp3")
    with pytest.raises(InvalidCommand, match=r"no such protocol 'profibus'; there are ct-ansi, .*hcp2, .*msc"):
        find("profibus")


@every_protocol
def test_every_command_of_a_protocol_has_a_name(protocol: Protocol) -> None:
    """In the module of its profile's probe are all of its commands."""
    codec = inspect.getmodule(type(protocol.profile.probe))
    defined = {
        thing
        for thing in vars(codec).values()
        if isinstance(thing, type) and hasattr(thing, "idempotent") and hasattr(thing, "open")
    }
    assert {thing for thing in defined if thing.__module__ == getattr(codec, "__name__", "")} == set(
        protocol.commands.values()
    )


COMMANDS: list[tuple[str, Command[Any]]] = [
    ("hcp", hcp.Read(99)),
    ("hcp", hcp.Write(1, (1.5, -2))),
    ("hcp2", hcp2.Read(255)),
    ("hcp2", hcp2.Write(108, (CommandWord.ENABLE,), idempotent=True)),
    ("mentor", mentor.Read(1, 17)),
    ("mentor", mentor.ReadRun(1, 17, 3)),
    ("mentor", mentor.Write(4, 26, True)),
    ("mentor", mentor.Write(15, 60, 65535, wide=True)),
    ("ct-ansi", ct_ansi.Read(1, 21)),
    ("ct-ansi", ct_ansi.ReadRun(1, 21, 3)),
    ("ct-ansi", ct_ansi.Write(1, 21, -47.6)),
    ("ct-ansi", ct_ansi.Write(1, 21, True)),
    ("modbus", modbus.ReadRegisters(7, 10, "input")),
    ("modbus", modbus.ReadBits(7)),
    ("modbus", modbus.WriteCoils(7, (True, False), idempotent=True)),
    ("modbus", modbus.WriteRegisters(7, (65535,))),
    ("dc104", dc104.Read(0, minimum=0)),
    ("dc104", dc104.Write(12, 1500, maximum=100)),
    ("msc", msc.DataRead(2008)),
    ("msc", msc.DataWrite(2008, -1)),
    ("msc", msc.BlockRead(0)),
    ("msc", msc.BlockWrite(0, tuple(range(32)))),
    ("msc", msc.PickedData(2000, (0, 5))),
    ("msc", msc.PickedFlags((1, 2))),
    ("msc", msc.SetFlag(5)),
    ("msc", msc.ReadStatus()),
]


@pytest.mark.parametrize(("name", "command"), COMMANDS, ids=str)
def test_a_command_is_written_down_and_read_back(name: str, command: Command[Any]) -> None:
    protocol = find(name).protocol
    written = json.loads(json.dumps(protocol.write_down(command)))
    again = protocol.read_back(written)
    assert again == command
    address, timings = protocol.profile.addresses[0], protocol.profile.timings
    assert again.open(address, timings).request == command.open(address, timings).request


@pytest.mark.parametrize(
    ("written", "complaint"),
    [
        ({}, "hcp has no command None: use read, write"),
        ({"command": "erase"}, "hcp has no command 'erase'"),
        ({"command": "read"}, "hcp: read has the arguments element: look at element"),
        ({"command": "read", "element": 100}, "element"),
        ({"command": "read", "element": "1"}, "element"),
        ({"command": "read", "element": 1, "node": 3}, "hcp: read has the arguments element: look at node"),
        (
            {"command": "write", "element": 1, "values": [1], "idempotent": 1},
            "write: idempotent is true or false, not 1",
        ),
        ({"command": "write", "element": 1, "values": 5}, "hcp: write: 'int' object is not iterable"),
        ({"command": "write"}, "write has the arguments element, values, idempotent: look at element, values"),
    ],
)
def test_what_was_written_down_is_checked_again(written: dict[str, object], complaint: str) -> None:
    with pytest.raises(InvalidCommand, match=complaint):
        find("hcp").protocol.read_back(written)


def test_each_option_of_a_command_is_true_or_false() -> None:
    protocol = find("mentor").protocol
    written = protocol.write_down(mentor.Write(1, 17, 5))
    for name in ("high_resolution", "wide", "idempotent"):
        with pytest.raises(InvalidCommand, match=f"mentor: write: {name} is true or false, not 1"):
            protocol.read_back({**written, name: 1})


TEXTS = st.text(max_size=5) | st.sampled_from(["holding", "coil", "1", "a"])
SCALARS = st.none() | st.booleans() | st.integers(-3, 300) | st.integers() | st.floats() | TEXTS
VALUES = st.recursive(SCALARS, lambda some: st.lists(some, max_size=33) | st.dictionaries(TEXTS, some, max_size=2))


@pytest.mark.parametrize("protocol", one_by_default(protocols()), ids=lambda protocol: protocol.name)
@given(st.data())
def test_whatever_a_stranger_writes_down_is_a_command_that_can_be_sent_or_invalid(
    protocol: Protocol, data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(list(protocol.commands)))
    names = [part.name for part in dataclasses.fields(protocol.commands[name])]  # type: ignore[arg-type]  # each is one
    arguments = data.draw(st.fixed_dictionaries({}, optional=dict.fromkeys(names, VALUES)))
    try:
        command = protocol.read_back({**arguments, "command": name})
    except InvalidCommand:
        return
    exchange = command.open(protocol.profile.addresses[0], protocol.profile.timings)
    assert hash(command) == hash(protocol.read_back(protocol.write_down(command)))
    assert str(command)
    with contextlib.suppress(Refused, FrameError):
        exchange.feed(bytes(300))


def test_a_command_of_another_protocol_is_not_written_down() -> None:
    with pytest.raises(InvalidCommand, match="hcp2 has no command DataRead"):
        find("hcp2").protocol.write_down(msc.DataRead(1))


@pytest.mark.parametrize(("name", "capture_id"), [("HCP", 1), ("a b", 1), ("", 1), ("mine", 256), ("mine", -1)])
def test_a_name_that_could_not_be_typed_and_an_id_that_does_not_fit_are_refused(name: str, capture_id: int) -> None:
    hcp_kind = find("hcp")
    with pytest.raises(InvalidCommand):
        NodeKind(name, hcp_kind.handle, hcp_kind.make_device, items="nothing", capture_id=capture_id)


def test_naming_the_protocols_loads_no_emulated_device() -> None:
    code = (
        "import sys; from busmaster.registry import kinds; "
        "found = [kind.items for kind in kinds().values()]; "
        "print([name for name in sys.modules if name.startswith('busmaster.') and name.endswith('device') "
        "and '.protocols.' in name])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_a_protocol_has_a_kind_of_node() -> None:
    protocol = find("hcp").protocol
    with pytest.raises(InvalidCommand, match="hcp: a protocol has at least one kind of node"):
        Protocol(protocol.profile, (), protocol.commands, protocol.dialect)


def test_the_decimals_of_an_item_are_those_of_its_document() -> None:
    kind = find("mentor")
    decimals = {item.item: item.decimals for item in kind.documented if item.decimals}
    assert decimals
    for name, number in decimals.items():
        assert kind.decimals(name) == kind.decimals(f"{name}:wide") == number
    assert kind.decimals("99.99") == 0


def test_a_kind_makes_its_devices_with_the_delay_and_the_options_that_are_given() -> None:
    device: Any = make_device("modbus", 17, delay=Delay(0.5), size=7, lively=True)
    assert (device.address, device.delay, len(device.registers), device.lively) == (17, Delay(0.5), 7, True)
    plain: Any = make_device("modbus", 17)
    assert (plain.delay, plain.lively) == (Delay(), False)
    with pytest.raises(InvalidCommand, match="no such protocol 'modbu'; did you mean 'modbus'"):
        make_device("modbu", 17)


def test_a_device_is_of_the_module_that_is_named() -> None:
    device: Any = device_of("busmaster.protocols.dc104.device")(0, maximum=9)
    assert list(device.parameters) == list(range(1, 10))


@pytest.mark.parametrize("item", ["1", "anything"])
def test_every_item_is_of_32_bits_unless_its_protocol_says_otherwise(item: str) -> None:
    assert (everywhere(item), nowhere(item), usual_width(item)) == (True, False, 32)
