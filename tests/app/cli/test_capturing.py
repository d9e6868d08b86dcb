"""`--capture FILE`: what cannot be recorded is said, and never stops the command."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click
import pytest

from busmaster.app.cli import capturing as module
from busmaster.app.cli.capturing import capturing
from busmaster.capture import COUNT, SIZE, Recorder
from busmaster.capture.pcapng import read_packets
from tests.app.cli.conftest import Command


def test_without_a_file_there_is_no_recorder() -> None:
    with capturing(None, port="COM1") as recorder:
        assert recorder is None


def test_the_file_is_complete_when_the_command_is_over(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "line.pcapng"
    with capturing(str(path), port="COM1", protocol="hcp2") as recorder:
        assert recorder is not None
        recorder.overheard(1.0, bytes.fromhex("07 30 32 02 30 31 05 04"))
    with path.open("rb") as file:
        assert len(list(read_packets(file))) == 2
    assert capfd.readouterr().err == ""


def test_a_file_that_cannot_be_made_is_wrong_usage(tmp_path: Path) -> None:
    with (
        pytest.raises(click.UsageError, match="nowhere"),
        capturing(str(tmp_path / "nowhere" / "line.pcapng"), port="COM1"),
    ):
        pass


def test_a_full_disk_is_said_at_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    with capturing("/dev/full", port="COM1") as recorder:
        assert recorder is not None
        recorder.overheard(1.0, bytes.fromhex("07 30 32 02 30 31 05 04"))
    assert "capture stopped: /dev/full: No space left on device" in capfd.readouterr().err


class Noted(Recorder):
    """A recorder that keeps its arguments, and reports a second file at once."""

    given: dict[str, Any]

    def __init__(self, path: str, **given: Any) -> None:
        Noted.given = given
        super().__init__(path, **given)
        given["report"](f"{path} is full")


@pytest.mark.parametrize(
    ("options", "size", "count"),
    [
        ((), SIZE, COUNT),
        (("--capture-mb", "2"), 2_000_000, COUNT),
        (("--capture-files", "3"), SIZE, 3),
        (("--capture-mb", "1", "--capture-files", "1"), 1_000_000, 1),
    ],
)
def test_size_and_number_of_files_are_those_of_the_options(
    busmaster: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    size: int,
    count: int,
) -> None:
    monkeypatch.setattr(module, "Recorder", Noted)
    at = ("socket://127.0.0.1:1?echo=1", "--protocol", "hcp2", "--node", "1", "1")
    ran = busmaster("read", *at, "--capture", str(tmp_path / "line.pcapng"), *options)
    assert ran.status == 1, "nothing listens on this port"
    del Noted.given["report"]
    assert Noted.given == {
        "port": "127.0.0.1:1",
        "protocol": "hcp2",
        "echo": True,
        "size": size,
        "count": count,
    }


@pytest.mark.parametrize("option", ["--capture-mb", "--capture-files"])
def test_a_capture_of_nothing_is_wrong_usage(busmaster: Command, option: str) -> None:
    ran = busmaster("read", "PORT", "--protocol", "hcp2", "--node", "1", "1", option, "0")
    assert ran.status == 2
    assert option in ran.err


@pytest.mark.parametrize("leaving", [None, KeyboardInterrupt])
@pytest.mark.parametrize(("output", "input_"), [(True, True), (True, False), (False, True)])
def test_what_the_recorder_reports_is_printed_at_once_unless_a_picture_may_be_drawn(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    output: bool,
    input_: bool,
    leaving: type[BaseException] | None,
) -> None:
    monkeypatch.setattr(module, "Recorder", Noted)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: output)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: input_)
    path = str(tmp_path / "line.pcapng")
    with nullcontext() if leaving is None else pytest.raises(leaving), capturing(path, port="COM1"):
        assert capfd.readouterr().err == ("" if output and input_ else f"busmaster: {path} is full\n")
        if leaving is not None:
            raise leaving
    assert capfd.readouterr().err == (f"busmaster: {path} is full\n" if output and input_ else "")


def test_a_file_that_exists_is_kept_and_the_other_name_is_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "line.pcapng"
    path.write_text("mine")
    with capturing(str(path), port="COM1") as recorder:
        assert recorder is not None
    assert path.read_text() == "mine"
    assert recorder.path != str(path)
    assert capfd.readouterr().err == f"busmaster: {path} exists; the capture goes to {recorder.path}\n"


class Failing(Recorder):
    """A recorder whose disk becomes full."""

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self.error = OSError(28, "No space left on device")
        self.dropped = 3


def test_a_capture_that_stopped_has_the_name_of_its_own_file_and_counts_what_it_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "Recorder", Failing)
    path = tmp_path / "line.pcapng"
    path.write_text("mine")
    with capturing(str(path), port="COM1") as recorder:
        assert recorder is not None
        capfd.readouterr()
    assert capfd.readouterr().err == (
        f"busmaster: capture stopped: {recorder.path}: No space left on device\n"
        "busmaster: the capture lacks 3 events that could not be written in time\n"
    )


@pytest.mark.parametrize(("count", "events"), [(1, "1 event"), (2, "2 events")])
def test_events_that_are_not_in_the_capture_are_counted(
    count: int, events: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with capturing(str(tmp_path / "line.pcapng"), port="COM1") as recorder:
        assert recorder is not None
        recorder.dropped = count
    assert capfd.readouterr().err == f"busmaster: the capture lacks {events} that could not be written in time\n"
