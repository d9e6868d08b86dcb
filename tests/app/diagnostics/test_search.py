"""Looking for nodes on a line that is set nobody knows how: in virtual time, with framings that no pty shows."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from math import inf

import pytest

from busmaster.app.diagnostics.probing import opened
from busmaster.app.diagnostics.search import CONFIRMED, MEASURED, Discovery, Search
from busmaster.app.diagnostics.steps import (
    LISTENING,
    Step,
    addresses,
    ranges,
    seconds,
    steps,
    untuned_steps,
    usual_kinds,
)
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.memory import MemoryPort, MemoryTransport
from busmaster.emulator.misheard import misheard
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand, LineDown
from busmaster.registry import NodeKind, find, kinds, make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport.identity import Identity
from tests.transport.fakes import without_rate

MODULI = {"hcp": 10**12, "hcp2": 10**12, "microflex": 10**12, "msc": 2**31, "mentor": 10**4, "ct-ansi": 10**4}
SHOWN = 3
"""Settings at which each protocol is found."""


def settings_of(kind: NodeKind) -> tuple[LineSettings, ...]:
    """Three settings of such nodes: those that they are met with, else their line's framing at other rates."""
    profile = kind.profile
    known = (profile.line, *profile.other_lines, *profile.line.at(4800, 38400))
    return tuple(dict.fromkeys(known))[:SHOWN]


def device_of(kind: NodeKind, address: int | None = None, **options: object) -> Device:
    at = addresses(kind.profile, None)[0] if address is None else address
    return make_device(kind.name, at, **options)  # type: ignore[arg-type]  # the maker's own


def line_of(settings: LineSettings, *devices: Device, **options: object) -> Line:
    return Line(settings, devices, chance=random.Random(1), **options)  # type: ignore[arg-type]  # Line's own


class Undeclared(MemoryPort):
    """A port of which nobody said that it echoes."""

    @property
    def echo(self) -> bool:
        return False


def looked(line: Line, tried: Sequence[Step], told: list[str] | None = None) -> Discovery:
    """What is found on the line by who does not know how it is set."""

    async def look() -> Discovery:
        port = Undeclared(line)
        async with opened(port) as wire:
            search = Search(wire, port, ([] if told is None else told).append)
            if talk := await search.listen(tried):
                return Discovery(talk=talk)
            return await search.look(tried)

    return run_in_virtual_time(look())


EVERY = [(kind, settings) for kind in kinds().values() for settings in settings_of(kind)]


@pytest.mark.parametrize(("kind", "settings"), EVERY, ids=lambda value: getattr(value, "name", None) or str(value))
def test_each_protocol_is_found_at_three_settings(kind: NodeKind, settings: LineSettings) -> None:
    known = settings in (kind.profile.line, *kind.profile.other_lines)
    nodes = addresses(kind.profile, None)[:3]
    line = line_of(settings, *(device_of(kind, node) for node in nodes))
    discovery = looked(line, steps(usual_kinds(), None, None if known else settings.baudrate))
    assert discovery.settings == settings
    assert {(node.protocol.name, node.address) for node in discovery.found} == {
        (kind.protocol.name, node) for node in nodes
    }


def test_all_that_is_tried_takes_less_than_a_minute() -> None:
    assert LISTENING < seconds(steps(usual_kinds(), None, None)) < 60


def every_probe() -> dict[bytes, str]:
    """Each request that a search may send, with who would."""
    return {
        step.kind.profile.probe.open(node, step.kind.profile.timings).request: f"{step.kind.name} {node}"
        for step in steps(usual_kinds(), None, None)
        for node in {
            *step.addresses,
            *step.kind.profile.addresses[:: max(1, len(step.kind.profile.addresses) // 16)],
        }
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_no_probe_changes_a_value_however_the_ends_are_set(kind: NodeKind) -> None:
    """Every request, said at every setting that is tried, into a device at every setting that it may have.

    Bytes with a wrong parity or stop bit are passed over, as devices do, and taken for good, as they should not be.
    """
    own = dict.fromkeys((kind.profile.line, *kind.profile.other_lines))
    tried = dict.fromkeys(step.settings for step in steps(usual_kinds(), None, None))
    heard: dict[bytes, str] = {}
    for request, who in every_probe().items():
        for said in tried:
            for settings in own:
                assert said is not None
                found = list(misheard(request, said, settings))
                for taken in (bytes(byte for byte, whole in found if whole), bytes(byte for byte, _ in found)):
                    heard[taken] = f"{who}, said at {said}, heard at {settings}"
    clock = count(1)
    for node in addresses(kind.profile, None)[:2]:
        memory = TraceableMemory(node, MODULI.get(kind.name, 2**16))
        device = device_of(kind, node, traceable=memory)
        line = line_of(kind.profile.line, device)
        for taken, how in heard.items():
            line.send(taken, float(next(clock)))
            line.receive(float(next(clock)))
            assert not any(memory.writes.values()), how
            assert not memory.foreign_writes, how


def test_that_a_write_would_be_noticed_there() -> None:
    memory = TraceableMemory(1)
    line = line_of(LineSettings(57600), make_device("hcp2", 1, traceable=memory))
    line.send(bytes.fromhex("07 30 31 02 30 31 35 03 34"), 0.0)
    line.receive(1.0)
    assert any(memory.writes.values())


def test_where_somebody_talks_nothing_is_sent_and_it_is_said_what_is_spoken() -> None:
    settings = LineSettings(9600)
    request, reply = bytes.fromhex("01 03 00 00 00 01 84 0A"), bytes.fromhex("01 03 02 00 00 B8 44")

    class Talkers(Device):
        """Another master and its unit, every 0.3 s."""

        def __init__(self) -> None:
            super().__init__(0)
            self.heard = b""
            self.wakeup = 0.1

        def hear_byte(self, byte: int, now: float) -> None:
            self.heard += bytes((byte,))

        def wake(self, now: float) -> None:
            self.reply(request, now, 0.0)
            self.reply(reply, now, 0.05)
            self.wakeup = now + 0.3

    talkers = Talkers()
    talkers.attentive = True
    discovery = looked(line_of(settings, talkers), steps(usual_kinds(), None, None))
    assert not discovery.found
    assert discovery.talk.startswith("another master is active, with Modbus RTU at 9600 8N1: ")
    assert talkers.heard == b""


class Talker(Device):
    """Transmits the same bytes again and again, and must not receive any."""

    def __init__(self, talk: bytes) -> None:
        super().__init__(0)
        self.wakeup = 0.1
        self._talk = talk

    def hear_byte(self, byte: int, now: float) -> None:
        raise AssertionError("something was sent")

    def wake(self, now: float) -> None:
        self.reply(self._talk, now, 0.0)
        self.wakeup = now + 0.3


def test_talk_in_an_unknown_protocol_is_left_alone_too() -> None:
    babbler = Talker(b"\x81\x82\x83")
    babbler.attentive = True
    discovery = looked(line_of(LineSettings(9600), babbler), steps(usual_kinds(), None, None))
    assert "with an unknown protocol" in discovery.talk


class Once(Talker):
    """Transmits some bytes once, at this time, and must not receive any."""

    def __init__(self, talk: bytes, at: float) -> None:
        super().__init__(talk)
        self.attentive = True
        self.wakeup = at

    def wake(self, now: float) -> None:
        self.reply(self._talk, now, 0.0)
        self.wakeup = inf


def test_a_master_that_has_fallen_silent_again_is_shown_by_its_bytes() -> None:
    master = Once(bytes.fromhex("07 30 35 02 30 31 05 03"), at=1.0)
    discovery = looked(line_of(LineSettings(57600), master), steps([find("hcp2")], None, None))
    assert discovery.talk == "another master is active, with an unknown protocol: 07 30 35 02 30 31 05 03"


def test_bytes_that_the_opening_of_a_port_causes_are_no_master() -> None:
    click = Once(b"\x11", at=0.02)
    click.attentive = False
    line = line_of(LineSettings(57600), click, make_device("hcp2", 3))
    discovery = looked(line, steps([find("hcp2")], (3,), LineSettings(57600)))
    assert (discovery.talk, [node.address for node in discovery.found]) == ("", [3])


def test_a_protocol_is_recognised_only_at_settings_at_which_it_is_tried() -> None:
    request = bytes.fromhex("07 30 35 02 30 31 05 03")  # HCP2: read element 1 of node 5

    for tried, talk in (
        (LineSettings(9600), "another master is active, with Host Comms Protocol 2 at 9600 8N1: "),
        (LineSettings(57600), "another master is active, with an unknown protocol: "),
    ):
        master = Talker(request)
        master.attentive = True
        asked = [*steps([find("hcp2")], None, tried), *steps([find("modbus")], None, LineSettings(9600))]
        assert looked(line_of(LineSettings(9600), master), asked).talk.startswith(talk)


def test_an_adapter_that_echoes_is_noticed() -> None:
    told: list[str] = []
    line = line_of(LineSettings(9600), make_device("hcp2", 3), echo=Echo())
    discovery = looked(line, steps(usual_kinds(), None, None), told)
    assert discovery.echo
    assert told[0] == "the adapter receives its own transmissions"
    assert [(node.address, node.label) for node in discovery.found] == [(3, "node 3")]


def test_an_echo_that_was_declared_is_not_news() -> None:
    told: list[str] = []
    port = MemoryPort(line_of(LineSettings(57600), make_device("hcp2", 3), echo=Echo()))

    async def look() -> Discovery:
        async with opened(port) as wire:
            return await Search(wire, port, told.append).look(steps([find("hcp2")], (3,), LineSettings(57600)))

    discovery = run_in_virtual_time(look())
    assert (discovery.echo, [node.address for node in discovery.found], told) == (True, [3], [])


def test_a_node_that_answers_after_the_window_is_found_under_its_own_address() -> None:
    """Its answer is heard behind the next node's request."""
    line = line_of(LineSettings(57600), make_device("hcp2", 2, delay=Delay(0.13)), make_device("hcp2", 5))
    discovery = looked(line, steps(usual_kinds(), None, None))
    assert [node.address for node in discovery.found] == [2, 5]
    assert discovery.found[0].starts[0] == pytest.approx(0.13, abs=0.01)


def test_the_time_to_a_reply_counts_from_the_requests_end_whatever_the_rate() -> None:
    """At 9600 baud a request takes 7 ms longer than at 57600 baud, the usual rate of these nodes."""
    settings = LineSettings(9600)
    line = line_of(settings, make_device("hcp2", 3, delay=Delay(0.02)))
    discovery = looked(line, steps([find("hcp2")], (3,), settings))
    [node] = discovery.found
    assert node.starts[0] == pytest.approx(0.02, abs=0.002)
    assert (len(node.starts), node.text, node.refuses) == (CONFIRMED + MEASURED, "read element 1: 0", False)


def test_a_protocol_is_tried_though_another_ones_probe_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    known = find("hcp2").protocol
    other = replace(known, kinds=tuple(map(replace, known.kinds)))
    monkeypatch.setattr("busmaster.app.diagnostics.steps.protocols", lambda: (known, other))
    assert {kind.protocol is other for kind in usual_kinds() if kind.profile.probe == known.profile.probe} == {
        False,
        True,
    }


class Fading(Device):
    """Answers node 3's probe so many times, and then nothing: so does noise that looks like an answer."""

    def __init__(self, answers: int) -> None:
        super().__init__(3)
        self.attentive = True
        self._left = answers
        self._heard = b""
        profile = find("hcp2").profile
        self._request = profile.probe.open(3, profile.timings).request
        line = line_of(profile.line, make_device("hcp2", 3))
        line.send(self._request, 0.0)
        self._answer = line.receive(1.0)

    def hear_byte(self, byte: int, now: float) -> None:
        self._heard += bytes((byte,))
        if self._left and self._heard.endswith(self._request):
            self._left -= 1
            self.reply(self._answer, now, 0.002)


@pytest.mark.parametrize(("answers", "found"), [(1, []), (2, []), (3, [3])])
def test_a_node_must_answer_twice_more_to_be_taken_for_one(answers: int, found: list[int]) -> None:
    line = line_of(LineSettings(57600), Fading(answers))
    discovery = looked(line, steps([find("hcp2")], (3,), LineSettings(57600)))
    assert [node.address for node in discovery.found] == found


def test_two_protocols_that_may_share_a_line_are_both_found() -> None:
    line = line_of(LineSettings(57600), make_device("hcp", 1), make_device("hcp2", 2))
    discovery = looked(line, steps(usual_kinds(), None, None))
    assert {(node.protocol.name, node.address) for node in discovery.found} == {("hcp", 1), ("hcp2", 2)}


def test_where_nodes_are_found_nothing_is_tried_that_cannot_share_their_line() -> None:
    line = line_of(LineSettings(57600), make_device("hcp2", 2))
    looked(line, steps(usual_kinds(), None, None))
    assert line.host is None, "the port is as the nodes have it"


def test_a_unit_that_refuses_is_found_too() -> None:
    line = line_of(LineSettings(19200, 8, "E"), make_device("modbus", 4, size=0))
    [node] = looked(line, steps(usual_kinds(), None, None)).found
    assert (node.address, node.refuses) == (4, True)


def test_on_an_empty_line_nothing_is_found() -> None:
    assert looked(line_of(LineSettings(57600)), steps(usual_kinds(), None, None)).found == []


def test_the_nodes_that_are_named_are_asked_where_they_exist() -> None:
    tried = steps(usual_kinds(), (0, 12), None)
    assert {step.kind.name: step.addresses for step in tried} == {
        "hcp": (0, 12),
        "hcp2": (0, 12),
        "microflex": (0, 12),
        "msc": (12,),
        "mentor": (12,),
        "ct-ansi": (12,),
        "ei-bisynch": (0, 12),
        "modbus": (12,),
        "dc104": (0,),
    }
    with pytest.raises(InvalidCommand, match="nothing is left to try"):
        steps([find("msc")], (99,), None)


def test_a_rate_or_settings_that_are_said_are_the_only_ones() -> None:
    assert {step.settings and step.settings.baudrate for step in steps(usual_kinds(), None, 4800)} == {4800}
    wanted = LineSettings(9600, 7, "E")
    assert {step.settings for step in steps(usual_kinds(), None, wanted)} == {wanted}


@pytest.mark.parametrize("kind", usual_kinds(), ids=lambda kind: str(kind.name))
def test_each_framing_of_a_kind_is_tried_once_at_a_named_rate(kind: NodeKind) -> None:
    known = [kind.profile.line, *kind.profile.other_lines]
    assert [step.settings for step in steps([kind], None, None)] == known
    tried = [step.settings for step in steps([kind], None, 4800)]
    assert all(settings is not None and settings.baudrate == 4800 for settings in tried)
    framings = dict.fromkeys(settings.framing for settings in known)
    assert [settings.framing for settings in tried if settings is not None] == list(framings)


def test_the_likeliest_settings_of_each_kind_are_tried_before_the_others() -> None:
    tried = [(step.kind.name, step.settings) for step in steps([find("hcp2"), find("ct-ansi")], None, None)]
    kinds = {kind: [settings for name, settings in tried if name == kind] for kind in ("hcp2", "ct-ansi")}
    for kind, settings in kinds.items():
        assert settings == [find(kind).profile.line, *find(kind).profile.other_lines]
    assert [name for name, _ in tried[:2]] == ["hcp2", "ct-ansi"]


def test_a_port_that_cannot_be_tuned_has_a_step_for_each_kind_that_has_the_nodes() -> None:
    tried = untuned_steps([find("hcp2"), find("msc")], (0, 200))
    assert [(step.kind.name, step.settings, step.addresses, step.rest) for step in tried] == [
        ("hcp2", None, (0, 200), ())
    ]
    [step] = untuned_steps([find("msc")], None)
    assert (step.addresses, step.rest) == (tuple(range(1, 9)), tuple(range(9, 16)))
    with pytest.raises(InvalidCommand, match="no protocol has these nodes: nothing is left to try"):
        untuned_steps([find("msc")], (99,))


def test_the_time_that_a_search_takes_is_that_of_all_requests_and_of_the_listening() -> None:
    profile = find("hcp2").profile
    [step] = untuned_steps([find("hcp2")], (1, 2, 3))
    each = profile.timings.read.window + 8 * profile.line.byte_time
    assert step.seconds == pytest.approx(3 * each)
    assert step.seconds_for((7,)) == pytest.approx(each)
    assert seconds([step, step]) == pytest.approx(3.0 + 6 * each)
    slow = replace(step, settings=LineSettings(1200))
    assert slow.seconds_for((7,)) == pytest.approx(profile.timings.read.window + 8 * LineSettings(1200).byte_time)


def found_on(line: Line, *names: str, told: list[str] | None = None) -> Discovery:
    return looked(line, steps([find(name) for name in names] or usual_kinds(), None, None), told)


AWKWARD = {
    "microflex": tuple(range(1, 11)),
    "ct-ansi": (12, 23),
    "modbus": (5, 17, 18),
    "hcp2": (8, 255),
    "hcp": (0, 1, 15),
    "msc": (1, 15),
    "mentor": (3, 99),
}


@pytest.mark.parametrize(("name", "nodes"), AWKWARD.items())
def test_if_a_node_replies_the_other_addresses_of_its_protocol_are_asked(name: str, nodes: tuple[int, ...]) -> None:
    told: list[str] = []
    line = line_of(find(name).profile.line, *(make_device(name, node) for node in nodes))
    discovery = found_on(line, name, told=told)
    assert sorted(node.address for node in discovery.found) == list(nodes)
    assert discovery.not_asked == {}
    assert "so the other addresses are tried too" in told[-1]


@pytest.mark.parametrize("ignores", [False, True])
def test_a_microflex_is_found_as_one_whether_it_refuses_or_ignores_the_reads_of_a_controller(ignores: bool) -> None:
    drives = [make_device("microflex", node, ignore_unmapped=ignores) for node in (2, 9)]
    line = line_of(find("microflex").profile.line, *drives, make_device("hcp2", 4), make_device("hcp2", 11))
    found = {node.address: (node.kind.name, node.refuses) for node in found_on(line).found}
    assert found == {2: ("microflex", False), 9: ("microflex", False), 4: ("hcp2", False), 11: ("hcp2", False)}


def test_the_other_addresses_are_announced_with_the_time_that_they_can_take() -> None:
    told: list[str] = []
    line = line_of(find("hcp").profile.line, make_device("hcp", 3), make_device("hcp2", 4))
    discovery = found_on(line, "hcp", "hcp2", told=told)
    assert [(node.kind.name, node.address) for node in discovery.found] == [("hcp", 3), ("hcp2", 4)]
    due = [next(step for step in steps([find(name)], None, None)) for name in ("hcp", "hcp2")]
    total = sum(step.seconds_for(step.rest) for step in due)
    assert told == [
        f"nodes have replied, so the other addresses are tried too (hcp 0, 9-15; hcp2 0, 9-255): up to {total:.0f} s"
    ]


def test_garbled_replies_are_reported_until_a_node_is_found() -> None:
    told: list[str] = []
    broken = make_device("hcp2", 2)
    broken.faults.wrong = 1.0
    found = found_on(line_of(LineSettings(57600), broken), "hcp2", told=told)
    assert found.found == []
    assert told[0].startswith("Host Comms Protocol 2, node 2 at 57600 8N1: ")
    told.clear()
    line = line_of(LineSettings(57600), make_device("hcp2", 1), broken)
    assert [node.address for node in found_on(line, "hcp2", told=told).found] == [1]
    assert not any(text.startswith("Host Comms Protocol 2, node 2") for text in told)


def test_what_was_not_asked_is_reported() -> None:
    line = line_of(find("hcp2").profile.line, make_device("hcp2", 3))
    discovery = found_on(line, "hcp", "hcp2")
    assert discovery.not_asked == {"hcp": (0, *range(9, 16))}, "no HCP node has replied"
    nothing = found_on(line_of(LineSettings(9600)), "msc")
    assert nothing.not_asked == {"msc": tuple(range(9, 16))}


def test_the_nodes_that_are_named_are_all_that_are_asked() -> None:
    line = line_of(find("hcp2").profile.line, *(make_device("hcp2", node) for node in (3, 20)))
    discovery = looked(line, steps([find("hcp2")], (3,), None))
    assert [node.address for node in discovery.found] == [3]


def test_the_user_is_offered_to_stop_on_a_slow_line_and_what_was_found_is_kept() -> None:
    line = line_of(find("modbus").profile.line, *(make_device("modbus", node) for node in (5, 12, 200)))
    offers: list[bool] = []

    def offered() -> Callable[[], bool]:
        offers.append(True)
        left = count(30, -1)
        return lambda: next(left) == 0

    async def look() -> Discovery:
        port = Undeclared(line)
        async with opened(port) as wire:
            return await Search(wire, port, lambda _: None, stop_offered=offered).look(
                steps([find("modbus")], None, None)
            )

    discovery = run_in_virtual_time(look())
    assert offers == [True]
    assert [node.address for node in discovery.found] == [5, 12]
    assert discovery.not_asked == {"modbus": tuple(range(39, 248))}


def test_where_the_other_addresses_take_little_time_the_user_is_not_offered_to_stop() -> None:
    def offered() -> Callable[[], bool]:
        raise AssertionError("offered")

    async def look() -> Discovery:
        port = Undeclared(line_of(find("msc").profile.line, make_device("msc", 12), make_device("msc", 3)))
        async with opened(port) as wire:
            search = Search(wire, port, lambda _: None, stop_offered=offered)
            return await search.look(steps([find("msc")], None, None))

    assert [node.address for node in run_in_virtual_time(look()).found] == [3, 12]


class Courses:
    """The courses of a search, each with the number of its steps and how many of these were shown."""

    def __init__(self) -> None:
        self.shown: dict[str, list[int]] = {}

    @contextmanager
    def __call__(self, label: str, steps: int) -> Iterator[Courses]:
        self.shown[label] = [steps, 0]
        yield self

    def advance(self) -> None:
        [*_, last] = self.shown.values()
        last[1] += 1


@pytest.mark.parametrize(
    ("devices", "shown"),
    [
        ([], {"asking": [5 * 8, 5 * 8]}),
        ([make_device("hcp2", 3)], {"asking": [5 * 8, 8], "trying the others": [248, 248]}),
        ([Once(b"\x11", at=1.0)], {"listening": [5, 5]}),
    ],
    ids=["silent", "node", "master"],
)
def test_a_search_shows_how_far_it_is(devices: list[Device], shown: dict[str, list[int]]) -> None:
    courses = Courses()
    port = Undeclared(line_of(LineSettings(57600), *devices))

    async def look() -> None:
        async with opened(port) as wire:
            search, tried = Search(wire, port, lambda _: None, courses), steps([find("hcp2")], None, None)
            if not await search.listen(tried):
                await search.look(tried)

    run_in_virtual_time(look())
    assert courses.shown == shown


class Choosy(Undeclared):
    """A port that does not take 57600 baud."""

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> MemoryTransport:
        return without_rate(await MemoryPort.open(self, protocol_factory, only), 57600)


def test_settings_that_the_port_does_not_take_are_reported_and_left_out() -> None:
    told: list[str] = []
    port = Choosy(line_of(LineSettings(9600), make_device("hcp2", 3)))

    async def look() -> Discovery:
        async with opened(port) as wire:
            return await Search(wire, port, told.append).look(steps([find("hcp2")], (3,), None))

    discovery = run_in_virtual_time(look())
    assert [(node.address, discovery.settings) for node in discovery.found] == [(3, LineSettings(9600))]
    assert told == ["left out: 57600 baud: invalid argument"]


class Fickle(Undeclared):
    """A port that takes its settings once. `lost`: then it is gone."""

    lost = False

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> MemoryTransport:
        transport = await MemoryPort.open(self, protocol_factory, only)
        tune, taken = transport.tune, list[LineSettings]()

        async def once(settings: LineSettings) -> None:
            taken.append(settings)
            if len(taken) == 1:
                return await tune(settings)
            if self.lost:
                transport.lose(LineDown("it hung up", hint=""))
                await asyncio.sleep(0.001)
            raise LineDown("no such settings", hint="")

        transport.tune = once  # type: ignore[method-assign]  # of this one
        return transport


class Vanishing(Fickle):
    lost = True


def test_addresses_whose_settings_are_not_taken_again_are_noted_as_not_tried() -> None:
    told: list[str] = []
    port = Fickle(line_of(LineSettings(57600), make_device("hcp2", 3)))

    async def look() -> Discovery:
        async with opened(port) as wire:
            return await Search(wire, port, told.append).look(steps([find("hcp2")], None, LineSettings(57600)))

    discovery = run_in_virtual_time(look())
    assert [node.address for node in discovery.found] == [3]
    assert discovery.not_asked == {"hcp2": (0, *range(9, 256))}
    assert told[-1] == "left out: no such settings"


def test_a_port_that_is_lost_while_it_is_set_ends_the_search() -> None:
    told: list[str] = []
    port = Vanishing(line_of(LineSettings(57600)))

    async def look() -> None:
        async with opened(port) as wire:
            await Search(wire, port, told.append).look(steps([find("hcp2")], (3,), None))

    with pytest.raises(LineDown, match="no such settings"):
        run_in_virtual_time(look())
    assert told == []


def test_addresses_are_written_as_ranges() -> None:
    assert ranges((0, 9, 10, 11, 255, 13)) == "0, 9-11, 13, 255"
    assert ranges(()) == ""
