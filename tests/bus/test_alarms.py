"""Alarms: each begins once and ends once, and what lies at a limit does not make it chatter."""

from __future__ import annotations

import logging
from dataclasses import replace
from math import nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.bus.alarms import AlarmChanged, Alarms
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning, MeansNothing
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.samples import Sample
from busmaster.errors import NoReply
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2.handle import Hcp2Controller
from tests.app.outputs.cycles import cycle, point
from tests.stories import cycles, on_a_bus

LIMITS = Meaning(low=10, high=20, hysteresis=2)
SPEED = replace(point("1"), unit="m/min", meaning=LIMITS)


def samples(value: Any) -> dict[Point[Any], Sample[Any]]:
    """One sample of element 1: a value, or what went wrong."""
    return cycle(1, value).samples


def told(*values: Any, of: Point[Any] = SPEED) -> list[str]:
    """What is told of these values, one cycle each."""
    texts: list[str] = []
    alarms = Alarms(lambda alarm: texts.append(alarm.text))
    for value in values:
        alarms.look([of], samples(value))
    return texts


def test_an_alarm_begins_beyond_its_limit_and_ends_when_the_value_is_back_by_the_hysteresis() -> None:
    assert told(15, 20, 20.5, 21, 18.5, 20.5, 18, 19) == [
        "5/1 = 20.5 m/min is above its high of 20 m/min",
        "5/1 is back at 18 m/min, was above its high of 20 m/min",
    ]
    assert told(10, 9, 11.9, 12) == [
        "5/1 = 9 m/min is below its low of 10 m/min",
        "5/1 is back at 12 m/min, was below its low of 10 m/min",
    ]


def test_a_value_that_jumps_from_one_side_to_the_other_ends_one_alarm_and_begins_the_other() -> None:
    assert told(25, 5) == [
        "5/1 = 25 m/min is above its high of 20 m/min",
        "5/1 is back at 5 m/min, was above its high of 20 m/min",
        "5/1 = 5 m/min is below its low of 10 m/min",
    ]


@pytest.mark.parametrize("unknown", [NoReply("no reply"), nan, "text"])
def test_what_is_not_known_neither_begins_an_alarm_nor_ends_one(unknown: Any) -> None:
    assert told(unknown, 15, unknown) == []
    assert len(told(25, unknown, 25)) == 1


@given(st.lists(st.floats(0, 30), max_size=60))
def test_alarms_begin_and_end_in_turn_and_never_within_the_hysteresis(values: list[float]) -> None:
    changes: list[AlarmChanged] = []
    alarms = Alarms(changes.append)
    for value in values:
        alarms.look([SPEED], samples(value))
        active = alarms.states[SPEED]
        if value > 20:
            assert active is not None
            assert active.limit == "high"
        if value < 10:
            assert active is not None
            assert active.limit == "low"
        if 12 <= value <= 18:
            assert active is None
    assert [change.active for change in changes] == [number % 2 == 0 for number in range(len(changes))]
    for change in changes:
        assert change.value is not None
        beyond = change.value > 20 if change.limit == "high" else change.value < 10
        back = change.value <= 18 if change.limit == "high" else change.value >= 12
        assert beyond if change.active else back


def test_a_ripple_at_the_limit_is_told_once_even_without_a_hysteresis_of_ones_own() -> None:
    speed = replace(SPEED, meaning=Meaning(low=10, high=20))
    assert len(told(*[20.01, 19.99] * 50, of=speed)) == 1


def test_the_bus_tells_what_is_polled_and_holds_what_is_active(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "busmaster")

    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        speed = replace(drive.point("10"), meaning=LIMITS)
        other = replace(drive.point("10"), meaning=LIMITS)
        events = bus.events()
        await drive.write(10, 15)
        group = bus.poll_group("axes", period=0.1, points=[speed])
        also = bus.poll_group("others", period=0.1, points=[other])
        await cycles(group, 2)
        assert dict(bus.alarms) == {speed: None}
        await drive.write(10, 30)
        await cycles(group, 2)
        await cycles(also, 2)
        active = bus.alarms[speed]
        assert active is not None
        assert (active.limit, active.bound, active.value) == ("high", 20, 30)
        group.remove(speed)
        also.remove(other)
        assert not bus.alarms
        events.close()
        changes = [event async for event in events if isinstance(event, AlarmChanged)]
        assert [(change.active, change.value) for change in changes] == [(True, 30), (False, None)]
        assert changes[1].text == "1/10 is watched no more, was above its high of 20"

    on_a_bus(story)
    levels = [(record.levelno, record.message.partition(": ")[2]) for record in caplog.records]
    assert (logging.WARNING, "1/10 = 30 is above its high of 20") in levels


def test_a_node_that_is_away_keeps_its_alarm_until_it_says_otherwise() -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        speed = replace(drive.point("10"), meaning=LIMITS)
        await drive.write(10, 30)
        group = bus.poll_group("axes", period=0.1, points=[speed])
        await cycles(group, 1)
        began = bus.alarms[speed]
        Node.of(drive).suspend(1.0)
        [snapshot] = await cycles(group, 1)
        assert snapshot[speed].error is not None
        assert bus.alarms[speed] is began

    on_a_bus(story, device)


def test_an_alarm_goes_on_while_other_points_of_its_group_come_and_go() -> None:
    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        speed, other = replace(drive.point("10"), meaning=LIMITS), drive.point("11")
        await drive.write(10, 30)
        group = bus.poll_group("axes", period=0.1, points=[speed])
        await cycles(group, 1)
        began, events = bus.alarms[speed], bus.events()
        assert began is not None
        group.add(other)
        assert bus.alarms[speed] is began
        await cycles(group, 1)
        assert set(bus.alarms) == {speed}, "a point without limits has no alarm"
        await cycles(group, 2)
        group.remove(other)
        await cycles(group, 2)
        assert bus.alarms[speed] is began
        events.close()
        assert [event async for event in events if isinstance(event, AlarmChanged)] == []

    on_a_bus(story)


def test_an_alarm_goes_on_while_another_group_still_polls_its_point() -> None:
    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        speed = replace(drive.point("10"), meaning=LIMITS)
        await drive.write(10, 30)
        groups = [bus.poll_group(name, period=0.1, points=[speed]) for name in ("a", "b", "c")]
        await cycles(groups[2], 2)
        began, events = bus.alarms[speed], bus.events()
        assert began is not None
        groups[0].remove(speed)
        groups[1].close()
        await cycles(groups[2], 2)
        assert bus.alarms[speed] is began
        groups[2].close()
        assert not bus.alarms
        events.close()
        changes = [event async for event in events if isinstance(event, AlarmChanged)]
        assert [(change.active, change.value) for change in changes] == [(False, None)]

    on_a_bus(story)


def test_each_of_several_overheard_values_may_begin_an_alarm() -> None:
    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        speeds = [replace(drive.point(item), meaning=LIMITS) for item in ("10", "11", "12")]
        [sample] = samples(30.0).values()
        bus._overheard(dict.fromkeys((*speeds, drive.point("13")), sample))
        assert {point for point, alarm in bus.alarms.items() if alarm is not None} == set(speeds)
        assert set(bus.alarms) == set(speeds), "a point without limits has no alarm"

    on_a_bus(story)


def word(**alarms: Any) -> Point[Any]:
    return replace(point("1"), meaning=Meaning(bits={"RUNS": 0, "FAULT": 3}, **alarms))


def told_of_bits(of: Point[Any], *values: int) -> list[str]:
    """What is told of the bits of a word, one cycle each."""
    texts: list[str] = []
    alarms = Alarms(lambda alarm: texts.append(alarm.text))
    bits = [bit for bit in of.bits if bit.meaning.watched]
    alarms.watch(bits)
    for value in values:
        alarms.look(bits, {bit: samples(bit.value_of(value))[point("1")] for bit in bits})
    alarms.forget(bits)
    return texts


def test_a_bit_begins_an_alarm_while_it_is_set() -> None:
    assert told_of_bits(word(alarm_if_set=("FAULT",)), 0, 1, 8, 9, 1, 8) == [
        "5/1.FAULT is set",
        "5/1.FAULT is clear again, was set",
        "5/1.FAULT is set",
        "5/1.FAULT is watched no more, was set",
    ]


def test_a_bit_begins_an_alarm_while_it_is_clear() -> None:
    assert told_of_bits(word(alarm_if_clear=("RUNS",)), 1, 9, 8, 0, 1, 0) == [
        "5/1.RUNS is clear",
        "5/1.RUNS is set again, was clear",
        "5/1.RUNS is clear",
        "5/1.RUNS is watched no more, was clear",
    ]


def test_only_the_bits_that_are_named_begin_alarms() -> None:
    assert told_of_bits(word(), 0, 9, 0) == []
    assert [bit.item for bit in word(alarm_if_set=("FAULT",)).bits if bit.meaning.watched] == ["1.FAULT"]


@pytest.mark.parametrize(
    ("alarms", "complaint"),
    [
        ({"alarm_if_set": ("FALT",)}, "'FALT' is not the name of a bit"),
        ({"alarm_if_clear": ("FALT",)}, "'FALT' is not the name of a bit"),
        ({"alarm_if_set": ("FAULT",), "alarm_if_clear": ("FAULT",)}, "FAULT is in alarm_if_set too"),
    ],
)
def test_an_alarm_of_a_bit_names_a_bit_once(alarms: Any, complaint: str) -> None:
    with pytest.raises(MeansNothing, match=complaint):
        word(**alarms)


def test_the_kind_of_an_alarm_is_its_limit_or_for_a_bit_its_state() -> None:
    kinds: list[str] = []
    alarms = Alarms(lambda alarm: kinds.append(f"{alarm.name} {alarm.active}"))
    watched = replace(point("2"), meaning=Meaning(low=0, high=10))
    bits = word(alarm_if_set=("FAULT",), alarm_if_clear=("RUNS",)).bits
    [sample] = samples(11.0).values()
    alarms.look([watched], {watched: sample})
    alarms.look([watched], {watched: sample._replace(value=-1.0)})
    alarms.look(bits, {bit: sample._replace(value=bit.item.endswith("FAULT")) for bit in bits})
    assert kinds == ["high True", "high False", "low True", "clear True", "set True"]
