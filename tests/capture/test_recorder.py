"""The tap: it notes and returns; a thread writes."""

from __future__ import annotations

import errno
import struct
import time
from contextlib import suppress
from pathlib import Path

import pytest

from busmaster.capture import recorder
from busmaster.capture.files import CaptureFiles
from busmaster.capture.pcapng import CaptureError, Outcome, read_packets
from busmaster.capture.recorder import Recorder
from busmaster.contract.tap import Attempt, Verdict
from busmaster.protocols.hcp2 import codec as hcp2
from tests.app.outputs.cycles import until
from tests.patience import PATIENCE

READ = hcp2.Read(1)
REQUEST = READ.open(2, hcp2.PROFILE.timings).request
REPLY = bytes.fromhex("02 30 31 35 03 37")


def attempt() -> Attempt:
    return Attempt("hcp2", 2, READ, hcp2.PROFILE.timings, transaction=1)


STATISTICS = 5
"""The type of a block with statistics, which closes a file."""


def block_types(data: bytes) -> list[int]:
    """The types of the blocks of a pcapng file."""
    types = []
    while data:
        kind, length = struct.unpack_from("<II", data)
        types.append(kind)
        data = data[length:]
    return types


def until_larger(path: Path, size: int) -> None:
    until(lambda: path.stat().st_size > size)


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


def test_packets_follow_a_clock_that_was_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, wall = tmp_path / "line.pcapng", time.time
    with Recorder(path) as tap:
        now = time.monotonic()
        for _ in range(2):
            tap.transmitted(now, REQUEST, attempt())
            tap.transmitted(now, REQUEST, attempt())  # the packet before it is written then
            size = path.stat().st_size
            until_larger(path, size)
            monkeypatch.setattr(time, "time", lambda: wall() + 3600.0)
    with path.open("rb") as file:
        packets = list(read_packets(file))
    assert 3599 < (packets[-1].micros - packets[0].micros) / 1e6 < 3601


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


def test_a_disk_that_has_room_again_when_the_recorder_is_closed_gets_all_that_waited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Disk(CaptureFiles):
        is_full = True

        def flush(self) -> None:
            if Disk.is_full:
                raise OSError(errno.ENOSPC, "No space left on device")
            super().flush()

    monkeypatch.setattr(recorder, "CaptureFiles", Disk)
    monkeypatch.setattr(recorder, "TICK", 0.001)
    monkeypatch.setattr(recorder, "RETRY", PATIENCE)
    said: list[str] = []
    with Recorder(tmp_path / "line.pcapng", report=said.append) as tap:
        tap.transmitted(time.monotonic(), REQUEST, attempt())
        until(lambda: tap.error is not None)
        tap.transmitted(time.monotonic(), REQUEST, attempt())
        Disk.is_full = False
    with (tmp_path / "line.pcapng").open("rb") as file:
        assert sum(packet.frame == REQUEST for packet in read_packets(file)) == 2
    assert (tap.error, tap.dropped) == (None, 0)
    assert said == [
        f"the capture rests: {tap.path}: No space left on device",
        f"the capture goes on: {tap.path}; nothing is lost",
    ]


def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(tmp_path / "nowhere" / "line.pcapng")


def test_every_verdict_of_an_arbiter_has_its_outcome_in_a_capture() -> None:
    assert {verdict.name for verdict in Verdict} == {outcome.name for outcome in Outcome} - {"NONE", "UNEXPECTED"}


def test_a_capture_of_a_silent_line_is_on_disk_before_it_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A read without a reply is judged by the silence behind it."""
    monkeypatch.setattr(recorder, "TICK", 0.001)
    monkeypatch.setattr(recorder, "IDLE", 0.01)
    path = tmp_path / "line.pcapng"

    def silences() -> int:
        with path.open("rb") as file, suppress(CaptureError):  # it is being written
            return sum(packet.outcome is Outcome.NO_REPLY for packet in list(read_packets(file)))
        return 0

    with Recorder(path, protocol="hcp2") as tap:
        for number in (1, 2):  # the silence is noticed each time
            tap.overheard(time.monotonic(), REQUEST)
            until(lambda number=number: silences() == number)  # type: ignore[misc]
    with path.open("rb") as file:
        packets = list(read_packets(file))
    assert [(packet.protocol, packet.frame, packet.outcome) for packet in packets] == [
        ("hcp2", REQUEST, Outcome.NONE),
        ("hcp2", b"", Outcome.NO_REPLY),
    ] * 2


def test_sent_bytes_that_are_received_too_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "line.pcapng"
    with Recorder(path, echo=True) as tap:
        now, asked = time.monotonic(), attempt()
        tap.transmitted(now, REQUEST, asked)
        tap.received(now + 0.002, REQUEST + REPLY, asked)
    with path.open("rb") as file:
        assert [packet.frame for packet in read_packets(file)] == [REQUEST, REPLY]


def test_events_that_are_lost_are_counted_once_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each packet has the events that were lost since the one before, the end of the file has all of them."""
    monkeypatch.setattr(recorder, "TICK", 0.001)
    path = tmp_path / "line.pcapng"
    with Recorder(path) as tap:
        for lost in (2, 3):
            tap.dropped += lost
            tap.received(time.monotonic(), b"\xff", None)
            size = path.stat().st_size
            tap.transmitted(time.monotonic(), REQUEST, attempt())
            until_larger(path, size)
    with path.open("rb") as file:
        assert [packet.dropped for packet in read_packets(file) if packet.dropped] == [2, 3]
    assert path.read_bytes()[-16:-8] == (5).to_bytes(8, "little")
    assert tap.dropped == 5


def test_a_recorder_can_be_closed_twice(tmp_path: Path) -> None:
    tap = Recorder(tmp_path / "line.pcapng")
    tap.close()
    size = (tmp_path / "line.pcapng").stat().st_size
    tap.close()
    assert (tmp_path / "line.pcapng").stat().st_size == size


def test_a_next_file_that_cannot_be_made_is_reported_once_and_made_as_soon_as_it_can_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts: list[None] = []

    class Counted(CaptureFiles):
        def begin_next(self) -> None:
            attempts.append(None)
            super().begin_next()

    monkeypatch.setattr(recorder, "CaptureFiles", Counted)
    monkeypatch.setattr(recorder, "TICK", 0.001)
    monkeypatch.setattr(recorder, "RETRY", 0.001)
    folder, away = tmp_path / "captures", tmp_path / "away"
    folder.mkdir()
    said: list[str] = []
    with Recorder(folder / "line.pcapng", port="COM", size=100, report=said.append) as tap:
        folder.rename(away)
        for _ in range(3):
            tap.transmitted(time.monotonic(), REQUEST, attempt())
        until(lambda: len(attempts) > 3)
        assert len(said) == 1
        away.rename(folder)
        until(lambda: len(said) == 2)
        tap.transmitted(time.monotonic(), REQUEST, attempt())
    assert said[0].startswith("the capture rests: ")
    assert said[0].endswith(": No such file or directory")
    assert said[1].endswith("; nothing is lost")
    assert (tap.error, tap.dropped, len(said)) == (None, 0, 2)
    frames = 0
    for path in folder.iterdir():
        assert b"COM" in path.read_bytes()
        assert block_types(path.read_bytes()).count(STATISTICS) == 1, "each file is closed once"
        with path.open("rb") as file:
            frames += sum(packet.frame == REQUEST for packet in read_packets(file))
    assert frames == 4
    assert len(list(folder.iterdir())) > 1
