"""Captures that go on for weeks: none is overwritten, their size is bounded, and a full disk is survived."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from busmaster.app.cli import main
from busmaster.capture.files import CaptureFiles
from busmaster.capture.pcapng import CutOff, Outcome, Packet, read_packets
from busmaster.capture.recorder import Recorder
from busmaster.contract.tap import Attempt, Verdict
from busmaster.protocols.hcp2 import codec as hcp2
from tests.app.outputs.cycles import until
from tests.disks import small_disk
from tests.patience import PATIENCE

READ = hcp2.Read(1)
REQUEST = READ.open(2, hcp2.PROFILE.timings).request
REPLY = bytes.fromhex("02 30 31 35 03 37")


def exchange(tap: Recorder, number: int) -> None:
    now, asked = time.monotonic(), Attempt("hcp2", 2, READ, hcp2.PROFILE.timings, transaction=number)
    tap.transmitted(now, REQUEST, asked)
    tap.received(now + 0.002, REPLY, asked)
    asked.end(Verdict.OK, 5.0, now + 0.002)
    tap.attempted(asked)


def packets(path: Path) -> Iterator[Packet]:
    """Up to where the file is cut off."""
    with path.open("rb") as file, suppress(CutOff):
        yield from read_packets(file)


def transactions(path: Path) -> list[int]:
    """Those that are recorded whole."""
    return [packet.transaction for packet in packets(path) if packet.outcome is Outcome.OK]


def test_a_file_that_is_there_is_never_overwritten(tmp_path: Path) -> None:
    first = tmp_path / "line.pcapng"
    first.write_text("somebody's")
    (tmp_path / "line-2.pcapng").write_text("as well")
    with Recorder(first) as tap:
        exchange(tap, 1)
    assert first.read_text() == "somebody's"
    assert (tmp_path / "line-2.pcapng").read_text() == "as well"
    assert tap.path == str(tmp_path / "line-3.pcapng")
    assert transactions(tmp_path / "line-3.pcapng") == [1]


def test_files_are_bounded_in_size_and_number_and_each_can_be_read_alone(tmp_path: Path) -> None:
    with Recorder(tmp_path / "line.pcapng", size=5_000, count=3) as tap:
        for number in range(1, 301):
            exchange(tap, number)
    files = sorted(tmp_path.iterdir(), key=lambda path: int(path.stem.partition("-")[2]))
    assert len(files) == 3
    assert files[-1] == Path(tap.path)
    assert all(path.stat().st_size < 5_500 for path in files)
    kept = [number for path in files for number in transactions(path)]
    assert kept == list(range(kept[0], 301))
    assert kept[0] > 150
    assert main(["replay", str(files[0])]) == 0


def test_only_its_own_old_files_are_removed(tmp_path: Path) -> None:
    other = tmp_path / "line-2.pcapng"
    other.write_text("somebody's")
    with Recorder(tmp_path / "line.pcapng", size=1_000, count=2) as tap:
        for number in range(60):
            exchange(tap, number)
    assert other.read_text() == "somebody's"
    assert len(list(tmp_path.iterdir())) == 3


def test_a_full_disk_is_said_and_what_passed_meanwhile_is_recorded_when_it_has_room() -> None:
    said: list[str] = []
    with small_disk(64) as disk:
        with Recorder(disk.folder / "line.pcapng", report=said.append) as tap:
            exchange(tap, 1)
            until(lambda: Path(tap.path).stat().st_size > 0 and transactions(Path(tap.path)) == [1])
            disk.fill()
            for number in range(2, 60):
                exchange(tap, number)
            until(lambda: bool(said))
            disk.clear()
            until(lambda: len(said) == 2)
            exchange(tap, 60)
        assert transactions(disk.folder / "line.pcapng") == list(range(1, 61))
    assert said[0].endswith("line.pcapng: No space left on device")
    assert said[1].endswith("nothing is lost")
    assert (tap.error, tap.dropped) == (None, 0)


def test_on_a_disk_that_stays_full_what_is_lost_is_counted_and_the_file_ends_where_it_was_cut() -> None:
    with small_disk(16) as disk:
        with Recorder(disk.folder / "line.pcapng", capacity=30) as tap:
            exchange(tap, 1)
            until(lambda: Path(tap.path).stat().st_size > 0 and transactions(Path(tap.path)) == [1])
            disk.fill()
            exchange(tap, 2)
            number = 2
            while tap.error is None:  # it took what was left of the page
                number += 1
                exchange(tap, number)
                until(lambda: tap.error is not None or not tap._events)
            for _ in range(100):
                number += 1
                exchange(tap, number)
        assert isinstance(tap.error, OSError)
        assert tap.dropped >= 270  # three events each; thirty of them waited to the end
        kept = transactions(disk.folder / "line.pcapng")
        assert kept == list(range(1, len(kept) + 1))
        lost = number - len(kept)
        assert tap.dropped >= 3 * lost


def test_what_one_writing_leaves_is_written_by_the_next() -> None:
    with small_disk(16) as disk:
        files = CaptureFiles(disk.folder / "line.pcapng")
        files.write(bytes(2_000))
        files.flush()
        disk.fill()
        files.write(b"x" * 10_000)
        with pytest.raises(OSError, match="No space left"):
            files.flush()
        assert 0 < files.pending < 10_000
        disk.clear()
        files.close()
        assert (disk.folder / "line.pcapng").read_bytes() == bytes(2_000) + b"x" * 10_000


def test_a_pipe_or_a_device_is_written_to_as_it_is(tmp_path: Path) -> None:
    pipe = tmp_path / "line.pcapng"
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        files = CaptureFiles(pipe, size=10)
        files.write(bytes(20))
        assert not files.full
        files.close()
        assert os.read(end, 100) == bytes(20)
    finally:
        os.close(end)
    assert files.path == str(pipe)
    assert list(tmp_path.iterdir()) == [pipe]


def test_an_old_file_that_was_moved_is_left_alone(tmp_path: Path) -> None:
    files = CaptureFiles(tmp_path / "line.pcapng", count=2)
    (tmp_path / "line.pcapng").rename(tmp_path / "kept.pcapng")
    for _ in range(3):
        files.begin_next()
    files.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept.pcapng", "line-3.pcapng", "line-4.pcapng"]


def test_a_file_is_full_when_it_has_its_size_with_the_bytes_that_wait(tmp_path: Path) -> None:
    files = CaptureFiles(tmp_path / "line.pcapng", size=10)
    files.write(bytes(4))
    files.flush()
    files.write(bytes(5))
    assert (files.full, files.pending) == (False, 5)
    files.write(bytes(1))
    assert files.full
    files.begin_next()
    assert (files.full, files.pending) == (False, 0)
    files.close()
    assert [path.stat().st_size for path in sorted(tmp_path.iterdir())] == [0, 10]


def test_a_file_is_closed_though_its_rest_cannot_be_written() -> None:
    files = CaptureFiles("/dev/full")
    files.write(b"x")
    with pytest.raises(OSError, match="No space left"):
        files.close()
    assert files._file.closed
    assert files.pending == 1


RECORD = """
import sys, time
from tests.capture.test_capture_files import Recorder, exchange
tap = Recorder(sys.argv[1])
number = 0
while True:
    number += 1
    exchange(tap, number)
    time.sleep(0.0005)
"""


@pytest.mark.slow
def test_a_capture_whose_process_was_killed_replays_up_to_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "line.pcapng"
    process = subprocess.Popen([sys.executable, "-c", RECORD, str(path)])
    try:
        until(lambda: path.exists() and path.stat().st_size > 20_000)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
    kept = transactions(path)
    assert kept == list(range(1, len(kept) + 1))
    data = path.read_bytes()
    middle = len(data) // 2
    zeroed = (data[: middle + n] + bytes(400) for n in range(64))  # as a loss of power may leave it
    for torn in (data[:-3], data[: middle + 5], data + bytes(100), *zeroed):
        path.write_bytes(torn)
        assert main(["replay", str(path)]) == 0
        said = capsys.readouterr()
        assert "0 changed" in said.out
        assert not said.out.startswith("0 exchanges")
        assert "cut in mid-block, after packet" in said.err
