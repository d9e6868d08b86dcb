"""Store and forward: what waits for a broker that is away survives on disk, bounded and counted."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.outputs.mqtt import MqttOutput
from busmaster.app.outputs.settings import MqttSettings
from busmaster.app.outputs.spool import Record, Spool
from busmaster.errors import InvalidCommand
from tests.app.outputs.brokers import Broker, needs_mosquitto
from tests.app.outputs.cycles import BUS, cycle, until
from tests.app.outputs.test_mqtt import heard, listening
from tests.disks import small_disk
from tests.patience import PATIENCE
from tests.ports import free_port


def record(number: int, values: int = 1) -> Record:
    return Record(str(number), values)


def spool_at(folder: Path, most: int, kind: str = "mqtt", say: Callable[[str], None] = lambda _: None) -> Spool:
    return Spool(str(folder / "spool"), most, kind, say)


def numbers(spool: Spool) -> list[int]:
    return [int(record.content) for record in spool.oldest(1_000_000)[1]]


def test_the_oldest_come_first_and_only_what_has_arrived_is_forgotten(tmp_path: Path) -> None:
    spool = spool_at(tmp_path, 100)
    assert spool.put(record(number) for number in range(10)) == 0
    up_to, first = spool.oldest(4)
    assert [record.content for record in first] == ["0", "1", "2", "3"]
    assert numbers(spool) == list(range(10))
    spool.remove(up_to, 4)
    assert (numbers(spool), spool.values) == (list(range(4, 10)), 6)


def test_it_is_all_there_again_after_a_restart(tmp_path: Path) -> None:
    spool = spool_at(tmp_path, 100)
    spool.put([record(1, 3), record(2)])
    spool.close()
    again = spool_at(tmp_path, 100)
    assert again.values == 4
    assert again.oldest(10)[1] == [record(1, 3), record(2)]


def test_it_is_bounded_in_values_and_says_how_many_had_to_go(tmp_path: Path) -> None:
    spool = spool_at(tmp_path, 50)
    assert sum(spool.put([record(number, 5)]) for number in range(30)) == 100
    assert (spool.values, numbers(spool)) == (50, list(range(20, 30)))
    assert spool.put(record(number) for number in range(3_000)) == 3_000
    assert (spool.values, numbers(spool)) == (50, list(range(2_950, 3_000)))


def test_two_processes_cannot_share_one(tmp_path: Path) -> None:
    spool = spool_at(tmp_path, 100)
    with pytest.raises(InvalidCommand, match="does another process use it"):
        spool_at(tmp_path, 100)
    spool.close()
    spool_at(tmp_path, 100).close()


def test_a_spool_that_another_process_holds_is_not_waited_for(tmp_path: Path) -> None:
    spool = spool_at(tmp_path, 100)
    assert spool._database.execute("pragma busy_timeout").fetchone() == (0,)
    spool.close()


def test_a_file_that_is_no_spool_is_kept_aside(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "spool").write_text("not a database at all " * 100)
    spool = spool_at(tmp_path, 100, "mqtt", said.append)
    assert spool.put([record(1)]) == 0
    assert (tmp_path / "spool.damaged").read_text().startswith("not a database")
    assert "begun anew" in said[0]


@pytest.mark.parametrize("damaged", [False, True])
@pytest.mark.parametrize(("strict", "level"), [(False, 1), (True, 2)])
def test_a_spool_has_its_mode_and_survives_a_loss_of_power_at_once_if_it_is_strict(
    tmp_path: Path, strict: bool, level: int, damaged: bool
) -> None:
    """Also one that is begun anew in place of a damaged file, which keeps the mode that it had."""
    if damaged:
        (tmp_path / "spool").write_text("not a database at all " * 100)
        (tmp_path / "spool").chmod(0o640)
    before = os.umask(0)
    try:
        spool = Spool(str(tmp_path / "spool"), 100, "mqtt", mode=0o604, strict=strict)
    finally:
        os.umask(before)
    assert spool._database.execute("pragma synchronous").fetchone() == (level,)
    spool.put([record(1)])
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    spool.close()
    of_the_damaged = {"spool.damaged": 0o640} if damaged else {}
    assert modes == {"spool": 0o604, "spool-wal": 0o604, **of_the_damaged}
    with pytest.raises(InvalidCommand, match="contains the stored values of mqtt; use another file for csv"):
        spool_at(tmp_path, 100, "csv")


@pytest.mark.slow
def test_a_spool_that_cannot_be_opened_is_an_error_in_words_and_leaves_no_file_open(tmp_path: Path) -> None:
    (tmp_path / "spool").mkdir()
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(InvalidCommand) as raised:
        spool_at(tmp_path, 100)
    assert "another process" not in str(raised.value)
    (tmp_path / "spool").rmdir()
    spool_at(tmp_path, 100, "csv").close()
    with pytest.raises(InvalidCommand, match="contains the stored values of csv; use another file for mqtt"):
        spool_at(tmp_path, 100, "mqtt")
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= before


# with an output


def output_to(port: int, folder: Path, say: Any = lambda _: None, **options: Any) -> MqttOutput:
    settings = MqttSettings(port=port, prefix="line", spill=str(folder / "spool"), **options)
    output = MqttOutput("mqtt", settings, BUS, say)
    output._retry = 0.02
    return output


async def values_heard(broker: Broker, output: MqttOutput, count: int) -> list[int]:
    """What a subscriber hears from an output that is started only when he listens."""
    async with listening(broker, "line/values/#") as client:
        output.start()
        found = await heard(client, count)
    await asyncio.to_thread(until, lambda: output.statistics().waiting == 0)
    await asyncio.to_thread(output.close, PATIENCE)
    return [payload["value"] for _, payload, _ in found]


@pytest.mark.slow
@needs_mosquitto
@pytest.mark.asyncio
async def test_what_a_broker_that_is_away_misses_is_sent_in_order_when_it_is_back(tmp_path: Path) -> None:
    """Ten times more than memory may hold."""
    broker = Broker(tmp_path)
    output = output_to(broker.port, tmp_path, buffer=50)
    output.start()
    for number in range(1, 501):
        output.offer(cycle(number, number))
        if number % 25 == 0:
            await asyncio.to_thread(until, lambda: output.spilled == output.offered)
    counts = output.statistics()
    assert (counts.dropped, counts.waiting, counts.spilled) == (0, 500, 500)
    async with asyncio.timeout(PATIENCE):
        await asyncio.to_thread(broker.start)
        try:
            async with listening(broker, "line/values/#") as client:
                found = [payload["value"] for _, payload, kept in await heard(client, 1)]
                await asyncio.to_thread(until, lambda: output.statistics().waiting == 0)
                while found[-1] != 500:
                    found += [payload["value"] for _, payload, _ in await heard(client, 1)]
        finally:
            await asyncio.to_thread(output.close, PATIENCE)
            await asyncio.to_thread(broker.stop)
    assert found == sorted(found)
    assert output.statistics() == type(counts)("mqtt", "written", 500, 0, 0, "", 0)


@pytest.mark.slow
@needs_mosquitto
@pytest.mark.asyncio
@pytest.mark.parametrize("silent", [False, True])
async def test_values_at_the_end_with_the_broker_away_are_kept_for_the_next_start(tmp_path: Path, silent: bool) -> None:
    """Also where something listens in its place and does not say a word."""
    with socket.create_server(("127.0.0.1", 0)) if silent else socket.socket() as deaf:
        port = deaf.getsockname()[1] if silent else free_port()
        output = output_to(port, tmp_path)
        output.start()
        for number in range(1, 301):
            output.offer(cycle(number, number))
        await asyncio.to_thread(output.close, PATIENCE)
    assert not output._thread.is_alive()
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.spilled) == (0, 0, 300)
    broker = Broker(tmp_path)
    await asyncio.to_thread(broker.start)
    try:
        again = output_to(broker.port, tmp_path)
        assert await values_heard(broker, again, 300) == list(range(1, 301))
    finally:
        await asyncio.to_thread(broker.stop)
    assert (again.statistics().written, again.statistics().dropped) == (300, 0)


@needs_mosquitto
@pytest.mark.asyncio
async def test_announcements_for_home_assistant_on_disk_are_not_counted_as_values(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    output = output_to(broker.port, tmp_path, home_assistant="homeassistant")
    output.start()
    output.offer(cycle(1, 12.5, 7.0))
    await asyncio.to_thread(until, lambda: output.spilled == 2)
    await asyncio.to_thread(broker.start)
    try:
        await asyncio.to_thread(until, lambda: not output.spilled)
    finally:
        await asyncio.to_thread(output.close, PATIENCE)
        await asyncio.to_thread(broker.stop)
    counts = output.statistics()
    assert (counts.written, counts.waiting, counts.dropped) == (2, 0, 0)


def spooled(folder: Path, kind: str = "mqtt") -> int:
    """How many values an output that is closed has left on disk."""
    spool = spool_at(folder, 1_000_000, kind)
    spool.close()
    return spool.values


PUBLISH = """
import asyncio, sys
from pathlib import Path
from tests.app.outputs.cycles import cycle
from tests.app.outputs.test_spool import output_to

async def publish():
    output = output_to(int(sys.argv[1]), Path(sys.argv[2]))
    output.start()
    number = 0
    while True:
        number += 1
        output.offer(cycle(number, number))
        print(output.spilled, flush=True)
        await asyncio.sleep(0.001)

asyncio.run(publish())
"""


def killed(folder: Path) -> int:
    """How many values it had on disk, by its own account, before it was."""
    command = [sys.executable, "-c", PUBLISH, str(free_port()), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        spilled = 0
        while spilled < 300:
            spilled = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
    return spilled


@pytest.mark.slow
@needs_mosquitto
@pytest.mark.asyncio
async def test_a_process_that_is_killed_loses_nothing_that_it_had_put_on_disk(tmp_path: Path) -> None:
    spilled = await asyncio.to_thread(killed, tmp_path)
    broker = Broker(tmp_path)
    await asyncio.to_thread(broker.start)
    try:
        again = output_to(broker.port, tmp_path)
        kept = spooled(tmp_path)
        assert kept >= spilled
        assert await values_heard(broker, again, kept) == list(range(1, kept + 1))
    finally:
        await asyncio.to_thread(broker.stop)


@needs_mosquitto
@pytest.mark.asyncio
async def test_a_full_disk_under_the_spool_is_told_once_and_memory_holds_what_it_can() -> None:
    said: list[str] = []
    with small_disk(1000) as disk:
        output = output_to(free_port(), disk.folder, said.append, buffer=400)
        disk.fill()
        output.start()
        for number in range(1, 1001):
            output.offer(cycle(number, number))
        await asyncio.to_thread(until, lambda: any("full" in text for text in said))
        disk.clear()
        await asyncio.to_thread(until, lambda: output.spilled == output.statistics().waiting > 0)
        await asyncio.to_thread(output.close, PATIENCE)
    counts = output.statistics()
    assert counts.spilled + counts.dropped == 1000
    assert counts.spilled > 0
    assert sum("full" in text for text in said) == 1
