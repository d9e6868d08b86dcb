"""`--capture FILE`: what cannot be recorded is said, and never stops the command."""

from __future__ import annotations

from pathlib import Path

import click
import pytest

from busmaster.app.cli.capturing import capturing
from busmaster.capture.pcapng import read_packets


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
