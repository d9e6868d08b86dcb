"""The tap: it notes and returns; a thread writes."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from busmaster.arbiter.tap import Attempt, Verdict
from busmaster.capture import recorder
from busmaster.capture.pcapng import Outcome, read_packets
from busmaster.capture.recorder import Recorder
from busmaster.protocols.hcp2 import codec as hcp2

READ = hcp2.Read(1)
REQUEST = READ.open(2, hcp2.PROFILE.timings).request
REPLY = bytes.fromhex("02 30 31 35 03 37")


def attempt() -> Attempt:
    return Attempt("hcp2", 2, READ, hcp2.PROFILE.timings, transaction=1)


def test_an_exchange_is_on_disk_when_the_recorder_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "line.pcapng"
    before = time.time()
    with Recorder(path, port="/dev/ttyUSB0") as tap:
        now, asked = time.monotonic(), attempt()
        tap.transmitted(now, REQUEST, asked)
        tap.received(now + 0.002, REPLY, asked)
        asked.end(Verdict.OK, 5.0, now + 0.002)
        tap.attempted(asked)
    with path.open("rb") as file:
        request, reply = read_packets(file)
    assert (request.frame, reply.frame) == (REQUEST, REPLY)
    assert (reply.outcome, reply.comment) == (Outcome.OK, "read element 1: 5.0")
    assert before - 1 < request.micros / 1e6 < time.time() + 1
    assert reply.micros - request.micros in range(1998, 2003)
    assert b"/dev/ttyUSB0" in path.read_bytes()
    assert (tap.dropped, tap.error) == (0, None)


def test_what_does_not_fit_is_dropped_and_counted_in_the_file_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "TICK", 30.0)
    tap = Recorder(tmp_path / "line.pcapng", capacity=4)
    for _ in range(10):
        tap.transmitted(time.monotonic(), REQUEST, attempt())
    tap.close()
    with (tmp_path / "line.pcapng").open("rb") as file:
        packets = list(read_packets(file))
    assert tap.dropped == sum(packet.dropped for packet in packets) == 6
    assert sum(packet.frame == REQUEST for packet in packets) == 4


def test_a_full_disk_stops_the_capture_and_nothing_else() -> None:
    tap = Recorder("/dev/full")
    tap.transmitted(time.monotonic(), REQUEST, attempt())
    tap.close()
    assert isinstance(tap.error, OSError)
    tap.transmitted(time.monotonic(), REQUEST, attempt())
    assert tap.dropped > 0


def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(tmp_path / "nowhere" / "line.pcapng")


def test_every_verdict_of_an_arbiter_has_its_outcome_in_a_capture() -> None:
    assert {verdict.name for verdict in Verdict} == {outcome.name for outcome in Outcome} - {"NONE", "UNEXPECTED"}
