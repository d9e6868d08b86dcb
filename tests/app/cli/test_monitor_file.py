"""`busmaster monitor LINE.toml`: points and outputs fed from what another master asks, without a byte of ours."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from socket import create_server
from typing import Any

import pytest

from busmaster.app.cli import main, monitor
from busmaster.app.cli.monitor import plain_values
from busmaster.app.cli.overheard import HeardGroup, Overheard
from busmaster.app.config import load
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.settings import MqttSettings
from busmaster.bus.samples import Quality, Sample
from busmaster.capture.decode import Decoder
from busmaster.capture.pcapng import read_packets
from busmaster.contract.frames import Direction
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import find
from tests.app.cli.conftest import Command, started
from tests.app.outputs.brokers import needs_mosquitto, running
from tests.app.outputs.cycles import until
from tests.app.outputs.test_mqtt import heard as heard_of
from tests.app.outputs.test_mqtt import listening
from tests.patience import PATIENCE

FILE = """
port = "socket://127.0.0.1:{port}?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 2
[nodes.winder.points]
tension = {{ item = "1", unit = "N", factor = 0.1, high = 0.4 }}
[nodes.spare]
protocol = "hcp2"
address = 3
[groups.fast]
period = 0.1
points = ["winder/tension"]
[outputs.sqlite]
path = "{folder}/line.sqlite"
"""
REQUEST = hcp2.Read(1).open(2, hcp2.PROFILE.timings).request
REPLY = bytes.fromhex("02 30 31 35 03 37")
"""Element 1 is 5."""
WINDOW = hcp2.PROFILE.timings.read.window
MAX_REPLY_DELAY = hcp2.PROFILE.timings.read.max_reply_delay


class Tapped:
    """A serial server on somebody else's line."""

    def __init__(self) -> None:
        self.heard = b""
        self.over = threading.Event()
        self._server = create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._server.accept()
        with connection:
            connection.settimeout(0.02)
            while not self.over.is_set():
                try:
                    connection.sendall(REQUEST + REPLY)
                    self.heard += connection.recv(100)
                except TimeoutError:
                    continue
                except OSError:
                    break

    def close(self) -> None:
        self.over.set()
        self._server.close()
        self._thread.join()


@contextmanager
def tapped() -> Iterator[Tapped]:
    line = Tapped()
    try:
        yield line
    finally:
        line.close()


def written(folder: Path, port: int = 1, file: str = FILE) -> Path:
    path = folder / "line.toml"
    path.write_text(file.format(port=port, folder=folder))
    return path


def rows(path: Path, query: str = "select node, item, value, unit from history") -> list[tuple[Any, ...]]:
    if not path.exists():
        return []
    database = sqlite3.connect(path, timeout=PATIENCE)
    try:
        return database.execute(query).fetchall()
    except sqlite3.OperationalError:
        return []  # it is just being made
    finally:
        database.close()


@pytest.mark.slow
def test_points_and_outputs_are_fed_and_not_a_byte_is_sent(tmp_path: Path) -> None:
    with tapped() as line:
        command = [sys.executable, "-m", "busmaster", "monitor", str(written(tmp_path, line.port)), "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            cycle = json.loads(process.stdout.readline())
            until(lambda: len(rows(tmp_path / "line.sqlite")) > 2)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=PATIENCE)
        assert line.heard == b""
    assert cycle["group"] == "fast"
    assert cycle["samples"]["winder/tension"] == {
        "value": 0.5,
        "quality": "overheard",
        "error": None,
        "late": False,
    }
    assert set(rows(tmp_path / "line.sqlite")) == {("winder", "tension", 0.5, "N")}
    assert "sqlite: " in said
    assert "0 dropped" in said
    alarm = "winder/tension = 0.5 N is above its high of 0.4 N"
    assert said.count(f"busmaster: {alarm}\n") == 1
    assert rows(tmp_path / "line.sqlite", "select node, text from events") == [("winder", alarm)]
    assert process.returncode == 130


@pytest.mark.slow
@needs_mosquitto
@pytest.mark.asyncio
async def test_mqtt_says_that_it_listens_and_of_the_state_of_a_line_that_nobody_asks_it_says_nothing(
    tmp_path: Path,
) -> None:
    with running(tmp_path) as broker, tapped() as line:
        path = written(tmp_path, line.port)
        path.write_text(path.read_text() + f'[outputs.mqtt]\nport = {broker.port}\nprefix = "line"\n')
        async with listening(broker, "line/#") as messages:
            with started("monitor", str(path)) as process:
                found = await heard_of(messages, 8)
                process.send_signal(signal.SIGINT)
                await asyncio.to_thread(process.communicate)
    topics = {topic for topic, *_ in found}
    assert {"line/status", "line/values/winder/tension", "line/alarms/winder/tension"} <= topics
    assert topics <= {"line/status", "line/values/winder/tension", "line/alarms/winder/tension", "line/events"}


def heard(folder: Path, *pieces: bytes, apart: float = 0.03) -> list[object]:
    """The values of the point that these pieces of the line, each some seconds behind the one before, stand for."""
    line = ConfiguredLine(load(written(folder)), outputs=False)
    points = line.members("fast")
    overheard = Overheard(find("hcp2").protocol, points, lambda: 0.0)
    overheard.groups.append(HeardGroup("fast", 0.1, points, 0.0))
    decoder = Decoder(find("hcp2").protocol.dialect())
    found: list[object] = []
    for number, piece in enumerate(pieces):
        for frame in decoder.feed(piece, number * apart, Direction.UNKNOWN) + decoder.quiet():
            overheard.heard(frame)
            snapshot = overheard.groups[0].turn(number * apart, 0.0)
            found += [sample.value for sample in snapshot.samples.values()] if snapshot else []
    return found


OTHER = hcp2.Read(2).open(2, hcp2.PROFILE.timings).request
OTHER_NODE = hcp2.Read(1).open(3, hcp2.PROFILE.timings).request


@pytest.mark.parametrize(
    ("pieces", "values"),
    [
        ([REQUEST + REPLY], [0.5]),
        ([REQUEST, REPLY], [0.5]),
        ([REPLY], []),
        ([OTHER + REPLY], []),
        ([OTHER_NODE + REPLY], []),
        ([REQUEST + REPLY[:-1] + b"\0"], []),
        ([REQUEST, REPLY[:3], REPLY], []),
        ([REQUEST + REPLY + REPLY], [0.5]),
        ([REQUEST, REQUEST + REPLY], [0.5]),
    ],
)
def test_only_the_answer_to_its_own_request_is_a_value(
    tmp_path: Path, pieces: list[bytes], values: list[object]
) -> None:
    assert heard(tmp_path, *pieces) == values


def test_an_answer_that_is_later_than_max_reply_delay_may_be_another_requests(tmp_path: Path) -> None:
    assert heard(tmp_path, REQUEST, REPLY, apart=1.0) == []
    assert heard(tmp_path, REQUEST, REPLY, apart=MAX_REPLY_DELAY + 0.001) == []


def test_a_reply_after_the_reply_window_is_a_value_until_max_reply_delay(tmp_path: Path) -> None:
    assert WINDOW < MAX_REPLY_DELAY - 0.001
    for delay in (WINDOW + 0.001, MAX_REPLY_DELAY - 0.001):
        assert heard(tmp_path, REQUEST, REPLY, apart=delay) == [0.5]


def test_what_is_missing_or_too_much_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", str(written(tmp_path)), "--protocol", "hcp2"]) == 2
    assert "leave out --protocol" in capsys.readouterr().err
    assert main(["monitor", "/dev/null"]) == 2
    assert "--protocol P, or a LINE.toml" in capsys.readouterr().err


NAK = b"\x15"
NO_COMMAND = b"\x07FF\x0200\x05\x07"
"""A request for element 0."""
REPLY_TO_NO_COMMAND = bytes.fromhex("02 30 30 35 03 36")


def asked(node: int, element: int = 1) -> bytes:
    return hcp2.Read(element).open(node, hcp2.PROFILE.timings).request


def overheard_of(
    folder: Path, *pieces: tuple[float, bytes], earlier: float = 0.0, file: str = FILE
) -> list[Sample[Any]]:
    """The samples of the points that these bytes, each at its time, stand for; the last came `earlier`."""
    line = ConfiguredLine(load(written(folder, file=file)), outputs=False)
    points = line.members("fast")
    now = [0.0]
    overheard = Overheard(find("hcp2").protocol, points, lambda: now[0])
    overheard.groups.append(HeardGroup("fast", 0.1, points, 0.0))
    decoder = Decoder(find("hcp2").protocol.dialect())
    found: list[Sample[Any]] = []
    for at, piece in pieces:
        now[0] = at
        for frame in decoder.feed(piece, at, Direction.UNKNOWN):
            frame.earlier = earlier if at == pieces[-1][0] else 0.0
            overheard.heard(frame)
            snapshot = overheard.groups[0].turn(at, 0.0)
            found += snapshot.samples.values() if snapshot else []
    return found


@pytest.mark.parametrize(
    ("pieces", "values"),
    [
        pytest.param([(0, asked(3)), (0.03, asked(2)), (0.04, REPLY)], [], id="gone on to the next node"),
        pytest.param(
            [(0, asked(3)), (0.03, asked(3)), (0.04, REPLY), (0.05, asked(2)), (0.06, REPLY)], [], id="repeated"
        ),
        pytest.param([(0, asked(2)), (0.03, asked(2)), (0.04, REPLY), (0.05, REPLY)], [0.5], id="repeated to itself"),
        pytest.param(
            [(0, asked(3)), (0.03, asked(3)), (0.04, REPLY), (0.05, asked(2, 4)), (0.06, asked(2)), (0.07, REPLY)],
            [],
            id="open requests outlive what is asked in between",
        ),
        pytest.param(
            [
                (0, asked(3)),
                (MAX_REPLY_DELAY - 0.01, asked(3)),
                (MAX_REPLY_DELAY - 0.005, REPLY),
                (MAX_REPLY_DELAY + 0.03, asked(2)),
                (MAX_REPLY_DELAY + 0.04, REPLY),
            ],
            [],
            id="of two replies to a repeated request the second may still come",
        ),
        pytest.param([(0, asked(3, 4)), (0.03, asked(2)), (0.04, REPLY)], [0.5], id="its reply would begin otherwise"),
        pytest.param([(0, asked(3)), (0.03, asked(3)), (0.04, NAK), (0.05, asked(2)), (0.06, REPLY)], [], id="a NAK"),
        pytest.param([(0, asked(9)), (0.03, asked(2)), (0.04, REPLY)], [], id="of a node that is not in the file"),
        pytest.param([(0, b"\x07\x46\x46"), (0.15, asked(2)), (0.16, REPLY)], [], id="perhaps a damaged request"),
        pytest.param(
            [(0, asked(3)), (0.06 + MAX_REPLY_DELAY, asked(2)), (0.07 + MAX_REPLY_DELAY, REPLY)], [0.5], id="it is over"
        ),
        pytest.param(
            [(0, asked(2) + REPLY), (0.01, REPLY), (0.03, asked(2)), (0.04, REPLY)],
            [0.5, 0.5],
            id="an unexpected reply is not a request",
        ),
        pytest.param(
            [
                (0, asked(3)),
                (MAX_REPLY_DELAY - 0.03, NO_COMMAND),
                (MAX_REPLY_DELAY - 0.02, REPLY_TO_NO_COMMAND),
                (MAX_REPLY_DELAY + 0.05, asked(2)),
                (MAX_REPLY_DELAY + 0.06, REPLY),
            ],
            [],
            id="of two replies the one to a request that no command sends may still come",
        ),
        pytest.param(
            [(0, asked(3)), *((0.001, asked(3, 4)),) * 1000, (0.03, asked(2)), (0.04, REPLY)],
            [0.5],
            id="of more than a thousand the first is not open",
        ),
    ],
)
def test_a_reply_that_an_open_request_could_have_caused_is_no_value(
    tmp_path: Path, pieces: list[tuple[float, bytes]], values: list[float]
) -> None:
    assert [sample.value for sample in overheard_of(tmp_path, *pieces)] == values


@pytest.mark.parametrize(
    "passed",
    [
        pytest.param(NO_COMMAND, id="element 0"),
        pytest.param(b"\x07FF\x0229--1417\x03\x09", id="a value that is not a number"),
    ],
)
def test_a_request_that_no_command_sends_is_open_and_does_not_end_the_listener(tmp_path: Path, passed: bytes) -> None:
    for later, values in ((0.03, []), (5.0, [0.5])):
        samples = overheard_of(tmp_path, (0, passed), (later, asked(2)), (later + 0.01, REPLY))
        assert [sample.value for sample in samples] == values


def test_a_request_is_open_while_its_reply_may_have_come_before_it_was_read(tmp_path: Path) -> None:
    late = MAX_REPLY_DELAY + 0.06
    pieces = [(0.0, asked(3)), (late, asked(2)), (late + 0.01, REPLY)]
    assert [sample.value for sample in overheard_of(tmp_path, *pieces, earlier=0.0)] == [0.5]
    assert overheard_of(tmp_path, *pieces, earlier=0.05 + late - MAX_REPLY_DELAY) == []


def with_delay(seconds: float) -> str:
    """A file whose first node has a maximum reply delay of its own, and both nodes a point."""
    timing = f"timing = {{{{ window = {seconds}, max_reply_delay = {seconds} }}}}"
    file = FILE.replace("address = 2\n", f"address = 2\n{timing}\n")
    return file.replace('points = ["winder/tension"]', 'points = ["winder/tension", "spare/1"]')


@pytest.mark.parametrize("own", [MAX_REPLY_DELAY / 2, 3 * MAX_REPLY_DELAY])
def test_a_reply_is_in_time_by_the_maximum_reply_delay_of_its_node(tmp_path: Path, own: float) -> None:
    for node, delay, value in ((2, own, 0.5), (3, MAX_REPLY_DELAY, 5.0)):
        for late, values in ((-0.01, [value]), (0.01, [])):
            samples = overheard_of(tmp_path, (0, asked(node)), (delay + late, REPLY), file=with_delay(own))
            assert [sample.value for sample in samples] == values


@pytest.mark.parametrize("own", [MAX_REPLY_DELAY / 2, 3 * MAX_REPLY_DELAY])
def test_a_request_is_open_until_the_maximum_reply_delay_of_its_node(tmp_path: Path, own: float) -> None:
    for late, values in ((-0.01, []), (0.01, [5.0])):
        pieces = [(0, asked(2)), (own + late - 0.005, asked(3)), (own + late, REPLY)]
        assert [sample.value for sample in overheard_of(tmp_path, *pieces, file=with_delay(own))] == values


def test_what_is_overheard_is_never_good_and_as_old_as_its_first_byte_may_be(tmp_path: Path) -> None:
    before = time.monotonic()
    (sample,) = overheard_of(tmp_path, (5.0, asked(2)), (5.02, REPLY), earlier=3.0)
    assert sample.quality is Quality.OVERHEARD
    assert not sample.quality.is_current
    assert before - 3.1 < sample.finished <= time.monotonic() - 3.0
    assert sample.age(time.monotonic()) >= 3.0
    assert time.time() - 3.1 < sample.wall <= time.time() - 3.0


@contextmanager
def line_of(*pieces: bytes, then: Callable[[int], object] = lambda _: None) -> Iterator[int]:
    """The port of a line that carries these bytes, and calls `then` with the number of each piece; then it is lost."""
    with create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                for number, piece in enumerate(pieces):
                    connection.sendall(piece)
                    then(number)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            thread.join()


@pytest.mark.parametrize(
    ("line", "note"),
    [
        (asked(2) + REPLY, ""),
        (asked(3) + asked(2) + REPLY, "1 reply could belong to an earlier request and was discarded"),
        (
            asked(3) + asked(2) + REPLY + asked(2) + REPLY,
            "2 replies could belong to earlier requests and were discarded",
        ),
    ],
)
def test_the_number_of_replies_that_were_discarded_is_reported_at_the_end(
    busmaster: Command, tmp_path: Path, line: bytes, note: str
) -> None:
    with line_of(line) as port:
        ran = busmaster("monitor", str(written(tmp_path, port)))
    assert ran.status == 1
    reports = [text for text in ran.err.splitlines() if "discarded" in text]
    assert reports == ([f"busmaster: {note}"] if note else [])
    assert "busmaster: sqlite: " in ran.err
    assert ran.err.splitlines()[-1].startswith("busmaster: the line was closed")


def test_the_end_of_an_alarm_is_of_less_weight_than_its_start(
    busmaster: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the journal of systemd, to which standard error leads here."""
    status = os.fstat(sys.stderr.fileno())
    monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
    stored = tmp_path / "line.sqlite"
    low = asked(2) + bytes.fromhex("02 30 31 33 03 31")
    with line_of(asked(2) + REPLY, low, then=lambda number: until(lambda: len(rows(stored)) > number)) as port:
        ran = busmaster("monitor", str(written(tmp_path, port)))
    assert [line for line in ran.err.splitlines() if "winder/tension" in line] == [
        "<4>busmaster: winder/tension = 0.5 N is above its high of 0.4 N",
        "<5>busmaster: winder/tension is back at 0.3 N, was above its high of 0.4 N",
    ]


def test_the_line_of_a_file_is_recorded(busmaster: Command, tmp_path: Path) -> None:
    capture = tmp_path / "line.pcapng"
    with line_of(asked(2) + REPLY) as port:
        ran = busmaster("monitor", str(written(tmp_path, port)), "--capture", str(capture))
    assert ran.status == 1
    with capture.open("rb") as file:
        assert [packet.frame for packet in read_packets(file)] == [asked(2), REPLY]


def test_an_output_that_fails_is_reported_while_it_listens(busmaster: Command, tmp_path: Path) -> None:
    (tmp_path / "line.sqlite").mkdir()
    with line_of(asked(2) + REPLY) as port:
        ran = busmaster("monitor", str(written(tmp_path, port)))
    assert "busmaster: sqlite is down: " in ran.err


def test_a_listener_accepts_no_commands_of_a_broker(
    busmaster: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[ConfiguredLine] = []

    def kept(*arguments: Any, **options: Any) -> ConfiguredLine:
        made.append(ConfiguredLine(*arguments, **options))
        return made[0]

    monkeypatch.setattr(monitor, "ConfiguredLine", kept)
    with line_of(asked(2) + REPLY) as port:
        path = written(tmp_path, port)
        path.write_text(path.read_text() + '[outputs.mqtt]\nport = 1\nallow_commands = ["winder/tension"]\n')
        busmaster("monitor", str(path))
    settings = made[0].file.outputs["mqtt"]
    assert isinstance(settings, MqttSettings)
    assert settings.allow_commands == ()


def test_a_value_is_printed_with_the_time_at_which_it_was_received(tmp_path: Path) -> None:
    line = ConfiguredLine(load(written(tmp_path)), outputs=False)
    points = line.members("fast")
    overheard = Overheard(find("hcp2").protocol, points, lambda: 0.0)
    overheard.groups.append(HeardGroup("fast", 0.1, points, 0.0))
    for frame in Decoder(find("hcp2").protocol.dialect()).feed(asked(2) + REPLY, 0.0, Direction.UNKNOWN):
        overheard.heard(frame)
    snapshot = overheard.groups[0].turn(time.monotonic(), time.time() + 3600)
    assert snapshot is not None
    [text] = plain_values(snapshot)
    moment, name, value = text.split()
    assert (name, value) == ("winder/tension", "0.5")
    assert abs(datetime.fromisoformat(moment).timestamp() - time.time()) < PATIENCE


@pytest.mark.slow
def test_a_listener_that_stood_still_tells_no_old_value_as_new(tmp_path: Path) -> None:
    with create_server(("127.0.0.1", 0)) as server:
        path = written(tmp_path, server.getsockname()[1])
        with started("monitor", str(path), "--json") as process:
            line, _ = server.accept()
            with line:
                assert process.stdout is not None
                line.sendall(REQUEST + REPLY)
                json.loads(process.stdout.readline())
                process.send_signal(signal.SIGSTOP)
                line.sendall(REQUEST + REPLY)
                said = time.time()
                time.sleep(1.0)  # how old the bytes become
                process.send_signal(signal.SIGCONT)
                json.loads(process.stdout.readline())
                process.send_signal(signal.SIGINT)
                process.communicate()
    moments = rows(tmp_path / "line.sqlite", "select time, quality from samples order by rowid")
    assert moments[-1][0] < said + 0.5
    assert {quality for _, quality in moments} == {"overheard"}
