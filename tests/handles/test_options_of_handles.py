"""The options of a call apply to each of its requests, whatever the handle and the method."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from busmaster import Bus, MemoryPort, Node, Priority, ReplyTiming, Timings
from busmaster.contract.exchange import Command
from busmaster.emulator.line import Line
from busmaster.protocols.ei_bisynch import codec as ei_bisynch
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.registry import NodeKind, find, kinds
from tests.handles.fake_bus import FakeBus

SLOW = Timings.uniform(ReplyTiming(0.1, 0.2, 0.3, 0.02))
Call = Callable[..., Awaitable[object]]


def answer(command: Command[Any]) -> Any:
    """Return a value that each kind of read can have: zeros."""
    match command:
        case _ if command.writes:
            return None
        case msc.BlockRead():
            return (0,) * 32
        case msc.ReadFlags():
            return frozenset()
        case msc.ReadStatus():
            return 0
        case modbus.ReadRegisters() | modbus.ReadBits() | mentor.ReadRun():
            return (0,) * command.count
        case ei_bisynch.ReadRun():
            return (0,) * len(command.names)
    return 5300.0 if "239" in str(command) else 0  # a firmware that has the map


CALLS: dict[str, tuple[str, dict[str, Any], Call]] = {
    "hcp2, read": ("hcp2", {}, lambda handle, **options: handle.read(1, **options)),
    "hcp2, several": ("hcp2", {}, lambda handle, **options: handle.read(1, 3, **options)),
    "hcp2, write": ("hcp2", {}, lambda handle, **options: handle.write(1, 0, 0, **options)),
    "hcp2, point": ("hcp2", {}, lambda handle, **options: handle.point("outputs").read(**options)),
    "hcp2, point, write": ("hcp2", {}, lambda handle, **options: handle.point("outputs").write(0, **options)),
    "hcp2, prepared": ("hcp2", {}, lambda handle, **options: handle._prepare_write("1", [0, 0], **options)[0]()),
    "microflex, status": ("microflex", {}, lambda handle, **options: handle.status(**options)),
    "microflex, in operation": ("microflex", {}, lambda handle, **options: handle.in_operation(**options)),
    "microflex, firmware": ("microflex", {}, lambda handle, **options: handle.check_firmware(**options)),
    "microflex, speed": ("microflex", {}, lambda handle, **options: handle.set_speed_reference(5, **options)),
    "microflex, torque": ("microflex", {}, lambda handle, **options: handle.set_torque_reference(5, **options)),
    "mentor, read": ("mentor", {}, lambda handle, **options: handle.read("1.17", **options)),
    "mentor, several": ("mentor", {}, lambda handle, **options: handle.read("1.17", 3, **options)),
    "mentor, chain": ("mentor", {}, lambda handle, **options: handle.read("1.17", 3, chain=True, **options)),
    "mentor, write": ("mentor", {}, lambda handle, **options: handle.write("1.17", 0, 0, **options)),
    "mentor, all": ("mentor", {}, lambda handle, **options: handle.write_all("1.17", 0, **options)),
    "mentor, prepared": ("mentor", {}, lambda handle, **options: handle._prepare_write("1.17", [0], **options)[0]()),
    "ct-ansi, read": ("ct-ansi", {}, lambda handle, **options: handle.read("1.21", **options)),
    "ct-ansi, write": ("ct-ansi", {}, lambda handle, **options: handle.write("1.21", 0, 0, **options)),
    "ct-ansi, prepared": ("ct-ansi", {}, lambda handle, **options: handle._prepare_write("1.21", [0], **options)[0]()),
    "ei-bisynch, read": ("ei-bisynch", {}, lambda handle, **options: handle.read("PV", **options)),
    "ei-bisynch, run": ("ei-bisynch", {}, lambda handle, **options: handle.point("PV,SL").read(**options)),
    "ei-bisynch, write": ("ei-bisynch", {}, lambda handle, **options: handle.write("SL", 0, **options)),
    "ei-bisynch, error": ("ei-bisynch", {}, lambda handle, **options: handle.last_error(**options)),
    "ei-bisynch, clear": ("ei-bisynch", {}, lambda handle, **options: handle.clear_error(**options)),
    "ei-bisynch, prepared": (
        "ei-bisynch",
        {},
        lambda handle, **options: handle._prepare_write("SL", [0], **options)[0](),
    ),
    "dc104, read": ("dc104", {}, lambda handle, **options: handle.read(1, **options)),
    "dc104, several": ("dc104", {}, lambda handle, **options: handle.read(1, 3, **options)),
    "dc104, write": ("dc104", {}, lambda handle, **options: handle.write(1, 0, 0, **options)),
    "dc104, prepared": ("dc104", {}, lambda handle, **options: handle._prepare_write("1", [0], **options)[0]()),
    "modbus, read": ("modbus", {}, lambda handle, **options: handle.read("holding:1", **options)),
    "modbus, several": ("modbus", {}, lambda handle, **options: handle.read("holding:1", 200, **options)),
    "modbus, write": ("modbus", {}, lambda handle, **options: handle.write("holding:1", *(0,) * 200, **options)),
    "modbus, prepared": (
        "modbus",
        {},
        lambda handle, **options: handle._prepare_write("holding:1", [0], **options)[0](),
    ),
    "msc, read": ("msc", {}, lambda handle, **options: handle.read(2000, **options)),
    "msc, several": ("msc", {"address_step": 4}, lambda handle, **options: handle.read(2000, 40, **options)),
    "msc, write": ("msc", {"address_step": 4}, lambda handle, **options: handle.write(2000, 0, 0, **options)),
    "msc, cam": ("msc", {"address_step": 4}, lambda handle, **options: handle.load_cam(2000, [0] * 33, **options)),
    "msc, run": ("msc", {"address_step": 4}, lambda handle, **options: handle.point("2000:40").read(**options)),
    "msc, short run": ("msc", {}, lambda handle, **options: handle.point("2000:4").read(**options)),
    "msc, run, write": (
        "msc",
        {"address_step": 4},
        lambda handle, **options: handle.point("2000:2").write((0, 0), **options),
    ),
    "msc, flag": ("msc", {}, lambda handle, **options: handle.flag(5, **options)),
    "msc, set flag": ("msc", {}, lambda handle, **options: handle.set_flag(5, **options)),
    "msc, clear flag": ("msc", {}, lambda handle, **options: handle.clear_flag(5, **options)),
    "msc, flags": ("msc", {}, lambda handle, **options: handle.flags(**options)),
    "msc, all flags": ("msc", {"model": "MSC-250"}, lambda handle, **options: handle.flags(**options)),
    "msc, status": ("msc", {}, lambda handle, **options: handle.status(**options)),
    "msc, in operation": ("msc", {}, lambda handle, **options: handle.in_operation(**options)),
    "msc, prepared": ("msc", {}, lambda handle, **options: handle._prepare_write("2000", [0], **options)[0]()),
    "msc, several prepared": (
        "msc",
        {"address_step": 4},
        lambda handle, **options: handle._prepare_write("2000", [0, 0], **options)[0](),
    ),
}


@pytest.mark.parametrize(("kind", "own", "call"), CALLS.values(), ids=CALLS)
@pytest.mark.asyncio
async def test_each_request_of_a_call_has_its_options(kind: str, own: dict[str, Any], call: Call) -> None:
    bus = FakeBus(answer)
    handle: Any = find(kind).handle(bus, find(kind).profile.addresses[-1], **own)
    await call(handle, priority=Priority.URGENT, start_within=7.0, retries=1)
    assert {options.get("priority") for options in bus.options} == {Priority.URGENT}
    # A value is read back with the priority alone.
    sent = [options for options in bus.options if options.keys() != {"priority"}]
    assert {(options.get("start_within"), options.get("retries")) for options in sent} == {(7.0, 1)}


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_the_timings_and_the_retries_of_a_handle_are_those_of_its_node(kind: NodeKind) -> None:
    bus = Bus(MemoryPort(Line(kind.profile.line)))
    node = Node.of(kind.handle(bus, kind.profile.addresses[-1], timings=SLOW, retries=7))
    assert (node.timings, node._record.retries) == (SLOW, 7)
