"""Events, cycles, points and counters have the same contents after they were sent to a client."""

from __future__ import annotations

import json
from dataclasses import replace
from math import inf
from typing import Any

import msgspec
import pytest

from busmaster import Bus, Hcp2Controller, InvalidCommand, MemoryPort, NoReply, Quality, Sample, Snapshot, ext
from busmaster.app.service import encoding, fields
from busmaster.app.service.messages import decode_owner_notification, decode_result, encode
from busmaster.arbiter.health import Health
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.emulator.line import Line
from busmaster.errors import GarbledReply
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.ext import Requester
from busmaster.protocols.hcp2 import microflex
from busmaster.statistics import DriverErrors, Timeline

BUS = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
POINT = replace(Hcp2Controller(BUS, 5).point("10"), unit="mm/s")
RECORD = ext.record_of(Node.of(Hcp2Controller(BUS, 5)))


def find(protocol: str, address: int, /) -> Requester:
    return Hcp2Controller(BUS, address).node


def find_record(protocol: str, address: int, /) -> Any:
    return ext.record_of(Node.of(Hcp2Controller(BUS, address)))


def sent(event: BusEvent) -> Any:
    """Return the form of an event at the client."""
    message = encode({"stream": 1, "dropped": 0, "body": encoding.encode_event(event)})
    return decode_owner_notification("event", msgspec.Raw(message)).body


@pytest.mark.parametrize(
    "event",
    [
        NodeChanged(RECORD, Health.DOWN, Health.UP, True),
        NodeChanged(RECORD, Health.UP, Health.SUSPECT, False),
        MaxReplyDelayRaised(RECORD, 0.25, 0.5),
        MaxReplyDelayLowered(RECORD, 0.125),
        RepliesLate(RECORD, 0.25, 0.2),
        LineChanged(LineChange.DOWN, "unplugged"),
        PortFailed("no such device", "plug it in"),
    ],
    ids=lambda event: type(event).__name__,
)
def test_a_client_gets_each_event_with_all_of_its_fields(event: BusEvent) -> None:
    assert encoding.event_of(sent(event), find_record) == event


def test_the_bug_because_of_which_a_port_is_not_reopened_is_named_with_its_class() -> None:
    again = encoding.event_of(sent(PortFailed("it failed", "report it", ValueError("no baudrate"))), find_record)
    assert isinstance(again, PortFailed)
    assert (again.cause, again.hint, str(again.bug)) == ("it failed", "report it", "ValueError: no baudrate")


@pytest.mark.parametrize(
    ("limit", "bound", "value", "active"),
    [("high", 40.0, 41.5, True), ("low", -inf, None, False), ("high", False, 1, True), ("low", True, 1, False)],
)
def test_a_client_gets_an_alarm_with_its_bound_and_the_owners_name_and_unit(
    limit: Any, bound: Any, value: Any, active: bool
) -> None:
    named = encoding.OwnersPoint(POINT.node, POINT.item, POINT.command, "mm/s", owners_key="winder/speed")
    again = encoding.event_of(sent(AlarmChanged(named, limit, bound, value, active)), find)
    assert isinstance(again, AlarmChanged)
    assert (again.limit, again.bound, again.value, again.active) == (limit, bound, value, active)
    assert type(again.bound) is type(bound)  # a bit has no number as its limit
    assert (again.point.key, again.point.unit, again.point.command) == ("winder/speed", "mm/s", POINT.command)


def test_an_owners_point_equals_one_that_reads_the_same_under_the_same_name() -> None:
    [form] = encoding.encode_points([POINT])
    point = encoding.owners_point_of(msgspec.structs.replace(form, key="winder/speed"), find)
    assert (point.key, point.item, point.unit) == ("winder/speed", "10", "mm/s")
    assert point == POINT
    for other in (
        replace(POINT, item="11"),
        replace(POINT, command=Hcp2Controller(BUS, 5).point("11").command),
        replace(POINT, node=Hcp2Controller(BUS, 6).node),
    ):
        assert point != other


TIMELINE = Timeline(1.0, 1.25, 1.5, 1.75, 2, 3, 0.125)


def sample(value: Any, error: Any = None, quality: Quality = Quality.GOOD) -> Sample[Any]:
    return Sample(value, error, 1.0, 1.25, 2.0, quality, TIMELINE, 1_700_000_000.5)


def cycle_at_the_client(*pairs: tuple[Point[Any], Sample[Any]]) -> Snapshot:
    snapshot = Snapshot(
        group="axes", samples=dict(pairs), cycle=7, due=1.0, started=1.125, finished=2.5, missed=3, wall=1_700_000_001.5
    )
    samples = [msgspec.Raw(encode(encoding.encode_sample(one))) for _, one in pairs]
    message = encode({"stream": 1, "dropped": 0, "body": encoding.encode_snapshot(snapshot, 4, samples)})
    body = decode_owner_notification("snapshot", msgspec.Raw(message)).body
    assert body.set == 4
    return encoding.snapshot_of(body, "axes", [point for point, _ in pairs])


def test_a_client_gets_a_cycle_with_its_times_and_its_samples() -> None:
    again = cycle_at_the_client((POINT, sample(12.5)))
    assert (again.group, again.cycle, again.due, again.started) == ("axes", 7, 1.0, 1.125)
    assert (again.finished, again.missed, again.wall) == (2.5, 3, 1_700_000_001.5)
    assert again.samples == {POINT: sample(12.5)}


def test_a_client_gets_a_failed_sample_with_its_error_and_does_not_decode_it_again() -> None:
    def decode(value: Any) -> Any:
        raise GarbledReply("not a position")

    failing = replace(POINT, item="11", decode=decode)
    again = cycle_at_the_client((POINT, sample(None, NoReply("no reply"), Quality.BAD)), (failing, sample(5.0)))
    failed, undecoded = again.samples[POINT], again.samples[failing]
    assert (type(failed.error), failed.value, failed.quality) == (NoReply, None, Quality.BAD)
    assert (type(undecoded.error), undecoded.value, undecoded.quality) == (GarbledReply, None, Quality.BAD)
    again = cycle_at_the_client((failing, sample(None, NoReply("no reply"), Quality.BAD)))
    assert type(again.samples[failing].error) is NoReply


@pytest.mark.parametrize("driver", [None, DriverErrors(1, 2, 3, 4, 5)])
def test_a_client_gets_the_counters_of_the_line(driver: DriverErrors | None) -> None:
    statistics = replace(ext.line_statistics(BUS), exchanges=7, quiet_time=0.5, losses=2, driver=driver)
    encoded = json.loads(encode(encoding.encode_statistics(statistics)))
    later = msgspec.Raw(json.dumps({**encoded, "counted_by_a_later_version": 1}).encode())
    assert encoding.statistics_of(decode_result("statistics", later)) == statistics


def test_a_probe_or_a_sync_read_alone_that_differs_is_sent_with_both() -> None:
    usual = Hcp2Controller.profile
    for other in (
        replace(usual, probe=microflex.PROFILE.probe),
        replace(usual, sync_reads=microflex.PROFILE.sync_reads),
    ):
        again = encoding.profile_of(fields.protocol_of("hcp2"), encoding.encode_sync_reads(other))
        assert (again.probe, again.sync_reads) == (other.probe, other.sync_reads)


def test_an_unknown_protocol_is_refused_with_the_names_of_the_known_ones() -> None:
    with pytest.raises(InvalidCommand, match=r"no such protocol 'hcp3'; there are .*hcp2.*modbus"):
        fields.protocol_of("hcp3")
