"""The tap: it notes and returns; a thread writes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Transaction
from busmaster.capture import recorder
from busmaster.capture.pcapng import Outcome, read_packets
from busmaster.capture.recorder import Recorder, outcome_of
from busmaster.errors import BusClosed, BusError, GarbledReply, NoReply, NoSuchParameter, Refused, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2

READ = hcp2.Read(1)
REQUEST = READ.open(2, hcp2.PROFILE.timings).request
REPLY = bytes.fromhex("02 30 31 35 03 37")


def ended(command: Any, value: Any = None, error: BusError | None = None) -> Transaction:
    transaction = Transaction(NodeRecord(hcp2.PROFILE, 2, hcp2.PROFILE.timings, 2), command)
    transaction.value, transaction.error, transaction.ended_at = value, error, time.monotonic()
    return transaction


def test_an_exchange_is_on_disk_when_the_recorder_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "line.pcapng"
    before = time.time()
    with Recorder(path, port="/dev/ttyUSB0") as tap:
        now = time.monotonic()
        tap.transmitted(now, REQUEST)
        tap.received(now + 0.002, REPLY)
        tap.completed(ended(READ, 5.0))
    with path.open("rb") as file:
        request, reply = read_packets(file)
    assert (request.frame, reply.frame) == (REQUEST, REPLY)
    assert (reply.outcome, reply.comment) == (Outcome.OK, "read element 1: 5.0")
    assert before - 1 < request.micros / 1e6 < time.time() + 1
    assert reply.micros - request.micros in range(1998, 2003)
    assert b"/dev/ttyUSB0" in path.read_bytes()
    assert (tap.dropped, tap.error) == (0, None)


def test_a_polls_transaction_may_run_again_before_its_verdict_is_written(tmp_path: Path) -> None:
    with Recorder(tmp_path / "line.pcapng") as tap:
        transaction = ended(READ, 5.0)
        tap.transmitted(time.monotonic(), REQUEST)
        tap.received(time.monotonic(), REPLY)
        tap.completed(transaction)
        transaction.reset()
    with (tmp_path / "line.pcapng").open("rb") as file:
        assert [packet.comment for packet in read_packets(file)] == ["", "read element 1: 5.0"]


def test_what_does_not_fit_is_dropped_and_counted_in_the_file_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "TICK", 30.0)
    tap = Recorder(tmp_path / "line.pcapng", capacity=4)
    for _ in range(10):
        tap.transmitted(time.monotonic(), REQUEST)
    tap.close()
    with (tmp_path / "line.pcapng").open("rb") as file:
        packets = list(read_packets(file))
    assert tap.dropped == sum(packet.dropped for packet in packets) == 6
    assert sum(packet.frame == REQUEST for packet in packets) == 4


def test_a_full_disk_stops_the_capture_and_nothing_else() -> None:
    tap = Recorder("/dev/full")
    tap.transmitted(time.monotonic(), REQUEST)
    tap.close()
    assert isinstance(tap.error, OSError)
    tap.transmitted(time.monotonic(), REQUEST)
    assert tap.dropped > 0


def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(tmp_path / "nowhere" / "line.pcapng")


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (NoReply("no reply"), Outcome.NO_REPLY),
        (GarbledReply("bad checksum"), Outcome.GARBLED),
        (Refused(), Outcome.REFUSED),
        (NoSuchParameter(), Outcome.REFUSED),
        (WriteUnconfirmed("no reply"), None),
        (BusClosed("closed"), None),
    ],
)
def test_errors_become_outcomes_where_they_say_what_was_on_the_wire(error: BusError, outcome: Outcome | None) -> None:
    assert outcome_of(error) is outcome
