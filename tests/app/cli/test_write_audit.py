"""What a process itself writes is on record, as what comes from outside is: by whom, and what became of it."""

from __future__ import annotations

import asyncio
import getpass
import signal
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.config import load
from busmaster.app.line.configured_line import ConfiguredLine
from busmaster.app.service.record import Outcome, WriteRecord
from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import Command, started, without_time
from tests.app.cli.test_leaving import SAFE, TEXT, drive_of, force, polls, winder
from tests.app.outputs.brokers import Broker, needs_mosquitto, running
from tests.app.outputs.test_mqtt import heard, listening
from tests.patience import PATIENCE

__all__ = ["winder"]  # a fixture

OUTPUTS = """
[outputs.sqlite]
path = "FOLDER/line.sqlite"
spill = "FOLDER/spool"
"""
LIMITED = TEXT.replace("factor = 0.1", "factor = 0.1, minimum = 1, maximum = 50")


@pytest.fixture
def path(tmp_path: Path, winder: TcpServer) -> Path:
    path = tmp_path / "line.toml"
    path.write_text((LIMITED + SAFE + OUTPUTS).replace("PORT", winder.path).replace("FOLDER", str(tmp_path)))
    return path


def audit(path: Path) -> list[tuple[Any, ...]]:
    """Interface, by whom, point, value, outcome and error of each write that is on record."""
    with sqlite3.connect(path.parent / "line.sqlite", timeout=PATIENCE) as database:
        rows = database.execute(
            "select interface, by, point, value, outcome, error from audit order by time"
        ).fetchall()
    database.close()
    return rows


def test_a_point_is_written_by_its_name_in_its_unit_and_that_is_on_record(
    busmaster: Command, path: Path, winder: TcpServer
) -> None:
    ran = busmaster("write", str(path), "winder/force=12.5", "winder/11=3", "--verify")
    assert (ran.status, ran.out, ran.err) == (0, "winder/force ok\nwinder/11 ok\n", "")
    assert force(winder) == 125
    assert audit(path) == [
        ("command line", "busmaster write", "winder/force", 12.5, "written", None),
        ("command line", "busmaster write", "winder/11", 3, "written", None),
    ]
    with sqlite3.connect(path.parent / "line.sqlite") as database:
        [(user,)] = database.execute("select distinct user from audit").fetchall()
    database.close()
    assert user == getpass.getuser()
    assert without_time(busmaster("write", str(path), "winder/force=2", "--json").out) == {
        "point": "winder/force",
        "ok": True,
    }


@pytest.mark.parametrize(
    ("said", "error"),
    [
        ("winder/force=51", "above its maximum of 50"),
        ("winder/10=9", "below its minimum of 1"),
        ("winder/axis0.idle=1", "is read-only"),
        ("winder/force=2,3", "does not accept 2 values ("),
        ("winder/force=2,3", "; write decimals with a point"),
        ("winder/force=inf", "finite number"),
        ("winder/force=1e308", "1e+308 is too large"),
        ("winder/farce=2", "no such item 'farce'"),
        ("rewinder/force=2", "no such point 'rewinder/force'"),
    ],
)
def test_what_is_refused_is_on_record_and_nothing_is_sent(
    busmaster: Command, path: Path, winder: TcpServer, said: str, error: str
) -> None:
    ran = busmaster("write", str(path), "winder/12=1", said)
    assert (ran.status, ran.out) == (2, "")
    assert error in ran.err
    [(_, _, point, _, outcome, why)] = audit(path)
    assert (point, outcome) == (said.partition("=")[0], "refused")
    assert error in why
    assert force(winder) == 0
    assert winder.call(lambda line, now: drive_of(line).read_element(12, now)) == 0


def test_a_write_that_is_not_answered_is_on_record_as_that(busmaster: Command, path: Path, winder: TcpServer) -> None:
    winder.call(lambda line, now: line.cut(now, line.device(1)))
    ran = busmaster("write", str(path), "winder/force=2")
    assert ran.status == 1
    [(*_, outcome, _)] = audit(path)
    assert outcome == "unconfirmed"


@pytest.mark.parametrize("option", [("--baud", "9600"), ("--protocol", "hcp2"), ("--node", "1"), ("--echo",)])
def test_what_the_file_says_is_not_said_again(busmaster: Command, path: Path, option: tuple[str, ...]) -> None:
    ran = busmaster("write", str(path), "winder/force=2", *option)
    assert ran.status == 2
    assert f"already defines the line; leave out {option[0]}" in ran.err


def test_without_a_file_the_protocol_is_missed(busmaster: Command) -> None:
    ran = busmaster("write", "/dev/null", "1=2")
    assert ran.status == 2
    assert "--protocol P, or a LINE.toml instead of the port" in ran.err


@pytest.mark.slow
@pytest.mark.parametrize(("number", "by"), [(signal.SIGTERM, "SIGTERM"), (signal.SIGINT, "SIGINT")])
def test_the_safe_state_at_the_end_of_a_run_is_on_record_with_what_ended_it(
    path: Path, number: signal.Signals, by: str
) -> None:
    with started("run", str(path), "--plain") as process:
        polls(process)
        process.send_signal(number)
        process.communicate(timeout=PATIENCE)
    assert audit(path) == [("safe", by, "winder/force", 1.5, "written", None)]


@pytest.mark.slow
def test_a_safe_write_that_is_not_confirmed_is_on_record_as_unconfirmed_once(path: Path, winder: TcpServer) -> None:
    with started("run", str(path), "--plain") as process:
        polls(process)
        winder.call(lambda line, now: line.cut(now, line.device(1)))
        process.terminate()
        process.communicate(timeout=PATIENCE)
    [(interface, _, _, _, outcome, _)] = audit(path)
    assert (interface, outcome) == ("safe", "unconfirmed")


def test_busmaster_safe_is_on_record_too(busmaster: Command, path: Path) -> None:
    assert busmaster("safe", str(path)).status == 0
    assert audit(path) == [("safe", "busmaster safe", "winder/force", 1.5, "written", None)]


def test_no_broken_output_is_in_the_way_of_busmaster_safe(busmaster: Command, path: Path, winder: TcpServer) -> None:
    path.write_text(path.read_text().replace("line.sqlite", "none/line.sqlite"))
    ran = busmaster("safe", str(path))
    assert (ran.status, ran.out) == (0, "winder/force ok\n")
    assert "these writes are not in the audit log" in ran.err
    assert force(winder) == 15
    assert busmaster("write", str(path), "winder/force=2").status == 2
    assert force(winder) == 15


def test_a_record_that_no_output_takes_waits_on_disk_or_is_told(busmaster: Command, path: Path, tmp_path: Path) -> None:
    (tmp_path / "line.sqlite").mkdir()
    assert "incomplete" not in busmaster("safe", str(path)).err
    (tmp_path / "line.sqlite").rmdir()
    assert busmaster("write", str(path), "winder/force=2").status == 0
    assert [row[0] for row in audit(path)] == ["safe", "command line"]
    (tmp_path / "line.sqlite").unlink()
    (tmp_path / "line.sqlite").mkdir()
    path.write_text(path.read_text().replace("spill =", "# spill ="))
    assert "sqlite: the audit log is incomplete: " in busmaster("safe", str(path)).err


@pytest.mark.asyncio
async def test_what_was_sent_once_stays_unconfirmed_whatever_keeps_it_from_being_sent_again(
    path: Path, winder: TcpServer
) -> None:
    """The line is lost while a safe write is repeated: that one was not started, but the first one may have arrived."""
    records: list[WriteRecord] = []
    line = ConfiguredLine(load(path), outputs=False)
    line.authorisation.record = records.append
    async with line.bus:
        await line.point("winder/force").read()
        winder.call(lambda line, now: line.cut(now, line.device(1)))
        [write] = line.safe_state.writes
        outcomes = await line.safe_state.enter(line.authorisation, "a test")
    assert outcomes[write.point.key] is not None
    assert [(record.outcome, record.by) for record in records] == [(Outcome.UNCONFIRMED, "a test")]


async def told_by_mqtt(broker: Broker, path: str) -> dict[str, Any]:
    """What is published, by topic, while a point of this file is written."""
    async with listening(broker, "busmaster/#") as client:
        with started("write", path, "winder/force=12.5") as process:
            out, err = await asyncio.to_thread(process.communicate, timeout=PATIENCE)
        assert (process.returncode, out, err) == (0, "winder/force ok\n", "")
        await client.publish("busmaster/over", "true", qos=1)
        topics: dict[str, Any] = {}
        while "busmaster/over" not in topics:
            [(topic, payload, _)] = await heard(client, 1)
            topics[topic] = payload
    return topics


@pytest.mark.slow
@needs_mosquitto
def test_mqtt_hears_of_the_write_and_nothing_of_a_line_that_another_process_may_run(path: Path, tmp_path: Path) -> None:
    with running(tmp_path) as broker:
        path.write_text(f'{path.read_text()}[outputs.mqtt]\nport = {broker.port}\nallow_commands = ["winder/force"]\n')
        topics = asyncio.run(told_by_mqtt(broker, str(path)))
    assert topics.pop("busmaster/audit")["interface"] == "command line"
    assert set(topics) <= {"busmaster/events", "busmaster/over"}
