"""`busmaster monitor`: lines and JSON of what passes, from a line that nobody asks anything."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from socket import create_server
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.cli import monitor
from busmaster.app.cli.capturing import capturing
from busmaster.app.cli.monitor import Listener, json_text, listen, plain_text
from busmaster.capture import DEFAULT_GAP
from busmaster.capture.decode import Decoder
from busmaster.capture.pcapng import Outcome, read_packets
from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.errors import LineDown
from busmaster.registry import find
from busmaster.transport.serial_port import SerialPort
from tests.app.cli.conftest import Command
from tests.patience import PATIENCE

HCP2 = "07 46 46 02 36 39 05 08  02 36 39 34 30 39 36 03 07"  # AN00129: read node 255 Comms(105), and 4096
MSC = (
    "02 03 00 07 00 00 52 46 4C 41 47 53 2C 01 F5 06 02 03 00 27 00 00 52 46 4C 41 47 53 2C 01" + " 00" * 31 + " 02 19"
)


def decoded(protocol: str, text: str) -> list[Frame]:
    decoder = Decoder(find(protocol).protocol.dialect())
    return decoder.feed(bytes.fromhex(text), 1_700_000_000.25) + decoder.quiet()


def test_a_frame_is_one_line_with_its_time_its_speaker_and_its_name() -> None:
    names = find("hcp2").handle._names_of_items()
    lines = [plain_text(frame, names) for frame in decoded("hcp2", HCP2 + "02 36 39 34 30 39 36 03 08")]
    fault = "bad checksum 08, not 07: 02 36 39 34 30 39 36 03 08"
    assert lines == [
        "2023-11-14T22:13:20.250000Z -> node 255 read 105 (axis0.encoder)",
        "2023-11-14T22:13:20.250000Z <- node 255 105 (axis0.encoder) = 4096  0.0 ms",
        f"2023-11-14T22:13:20.250000Z <-          105 (axis0.encoder) = 4096  ! {fault}",
    ]


def test_json_has_numbers_and_nulls() -> None:
    asked, answered = (
        json.loads(json_text(frame, find("hcp2").handle._names_of_items())) for frame in decoded("hcp2", HCP2)
    )
    assert asked == {
        "time": "2023-11-14T22:13:20.250000Z",
        "from": "host",
        "node": 255,
        "kind": "read",
        "command": "read",
        "item": "105",
        "name": "axis0.encoder",
        "value": None,
        "delay": None,
        "fault": None,
        "raw": "07 46 46 02 36 39 05 08",
    }
    assert (answered["kind"], answered["value"], answered["delay"]) == ("value", 4096, 0.0)
    assert type(answered["value"]) is int


@pytest.mark.parametrize(
    ("protocol", "text", "values"),
    [
        ("msc", MSC, [None, None, [0]]),
        ("hcp", "04 31 31 02 39 39 31 2C 32 03 2C 15", [[1, 2], None]),
        ("mentor", "04 31 31 34 34 02 30 31 31 37 2D 30 34 37 36 03 2C", [-476]),
        ("hcp", "02 30 31 31 2E 35 03 1B", [1.5]),
        ("hcp", "02 30 31 41 03 41", ["A"]),
        ("hcp", "00", [None]),
    ],
)
def test_json_values_are_numbers_or_lists_of_them_or_the_text_as_it_came(
    protocol: str, text: str, values: list[Any]
) -> None:
    assert [json.loads(json_text(frame, {}))["value"] for frame in decoded(protocol, text)] == values


def test_drives_have_names_of_their_own() -> None:
    assert find("microflex").handle._names_of_items()["109"] == "status_word"
    assert find("hcp").handle._names_of_items() == {}


@pytest.mark.asyncio
async def test_a_frame_that_is_cut_short_is_told_when_the_line_falls_silent() -> None:
    heard: asyncio.Queue[Frame] = asyncio.Queue()
    listener = Listener(Decoder(find("hcp2").protocol.dialect()), heard.put_nowait)
    listener.data_received(bytes.fromhex("07 30 32"))
    assert heard.empty()
    assert (await heard.get()).fault == "cut short after 3 bytes"
    listener.connection_lost(None)
    with pytest.raises(LineDown, match="closed"):
        await listener.lost


@pytest.mark.asyncio
async def test_whoever_reads_the_output_may_leave() -> None:
    def leave(_: Frame) -> None:
        raise BrokenPipeError

    listener = Listener(Decoder(find("hcp2").protocol.dialect()), leave)
    listener.data_received(bytes.fromhex(HCP2))
    with pytest.raises(BrokenPipeError):
        await listener.lost


def frame_of(**known: Any) -> Frame:
    """A reply, with these facts."""
    return Frame(**{"kind": Kind.VALUE, "sender": Direction.NODE, "raw": b"\x02", "time": 1_700_000_000.25, **known})


def test_a_frame_of_an_unknown_sender_with_a_fault_and_a_delay() -> None:
    frame = frame_of(sender=Direction.UNKNOWN, item="7", value="7", delay=0.0029, fault="cut short", node=5)
    assert plain_text(frame, {"7": "speed"}) == (
        "2023-11-14T22:13:20.250000Z ?? node 5   7 (speed) = 7  2.9 ms  ! cut short: 02"
    )
    fields = json.loads(json_text(frame, {"7": "speed"}))
    assert (fields["from"], fields["fault"], fields["delay"], fields["value"]) == (None, "cut short", 0.0029, 7)
    assert json.loads(json_text(frame_of(item="7", value="7", delay=0.00123456), {}))["delay"] == 0.001235


@pytest.mark.parametrize(
    ("item", "text", "value"),
    [("flags", "5", [5]), ("flags", "", []), ("7", "", []), ("7", "5", 5), ("7", "5,6", [5, 6]), ("7", "1e3", 1000.0)],
)
def test_flags_are_a_list_in_json_whatever_their_number(item: str, text: str, value: object) -> None:
    assert json.loads(json_text(frame_of(item=item, value=text), {}))["value"] == value


class Clock:
    """The time of day, as the test sets it."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


class Tap:
    """What a recorder would get."""

    def __init__(self) -> None:
        self.heard: list[bytes] = []
        self.moments: list[float] = []

    def overheard(self, moment: float, data: bytes) -> None:
        self.moments.append(moment)
        self.heard.append(data)


REQUEST = bytes.fromhex("07 46 46 02 36 39 05 08")


@pytest.mark.asyncio
async def test_a_frame_in_two_pieces_is_not_ended_by_the_silence_before_the_second() -> None:
    heard: list[Frame] = []
    loop = asyncio.get_running_loop()
    listener = Listener(Decoder(find("hcp2").protocol.dialect()), heard.append)
    began = loop.time()
    listener.data_received(REQUEST[:3])
    first = listener._timer
    assert first is not None
    assert began + DEFAULT_GAP <= first.when() <= loop.time() + DEFAULT_GAP
    listener.data_received(REQUEST[3:])
    assert first.cancelled()
    assert [frame.fault for frame in heard] == [""]
    listener.connection_lost(None)
    listener.lost.exception()


@pytest.mark.asyncio
async def test_bytes_before_a_loss_are_reported_and_the_loss_has_its_cause() -> None:
    heard: list[Frame] = []
    listener = Listener(Decoder(find("hcp2").protocol.dialect()), heard.append)
    listener.data_received(REQUEST[:3])
    beating = listener._beating
    listener.connection_lost(OSError(5, "Input/output error"))
    assert [frame.fault for frame in heard] == ["cut short after 3 bytes"]
    assert beating.cancelled()
    with pytest.raises(LineDown, match="Input/output error") as lost:
        await listener.lost
    assert lost.value.hint == "start again when it is back"
    listener.connection_lost(None)  # twice, as a transport may: the first cause counts


@pytest.mark.asyncio
async def test_of_several_failures_of_the_output_the_first_counts() -> None:
    errors = iter((BrokenPipeError(), OSError(28, "No space left on device")))

    def fail(_: Frame) -> None:
        raise next(errors)

    listener = Listener(Decoder(find("hcp2").protocol.dialect()), fail)
    listener.data_received(REQUEST)
    listener.data_received(REQUEST)
    listener.connection_lost(None)
    with pytest.raises(BrokenPipeError):
        await listener.lost


@pytest.mark.asyncio
async def test_bytes_that_may_have_waited_while_the_program_was_stopped_have_an_earlier_time() -> None:
    clock, heard = Clock(), list[Frame]()
    tap: Any = Tap()
    listener = Listener(Decoder(find("hcp2").protocol.dialect()), heard.append, tap, clock)
    clock.now += 0.01
    before = time.monotonic()
    listener.data_received(REQUEST)
    assert before <= tap.moments[0] <= time.monotonic()
    assert tap.heard == [REQUEST]
    clock.now += 5.0  # it stood still
    listener.data_received(REQUEST)
    listener._beat()
    listener.data_received(REQUEST)  # read in a second piece, behind the beat that ended the standstill
    clock.now += 0.05
    listener._beat()
    listener.data_received(REQUEST[:4])
    clock.now += 5.0
    listener.data_received(REQUEST[4:] + REQUEST)
    assert [round(frame.earlier, 3) for frame in heard[:3]] == [0.0, 5.01, 5.01]
    assert {round(frame.earlier, 3) for frame in heard[3:]} == {5.05}
    listener.connection_lost(None)
    listener.lost.exception()


@pytest.mark.asyncio
async def test_what_has_begun_before_a_standstill_keeps_its_doubt_until_it_is_whole() -> None:
    clock, heard = Clock(), list[Frame]()
    listener = Listener(Decoder(find("hcp2").protocol.dialect()), heard.append, clock=clock)
    clock.now += 5.0
    listener.data_received(REQUEST[:4])
    for _ in range(3):
        clock.now += 0.01
        listener._beat()
    listener.data_received(REQUEST[4:])
    listener.data_received(REQUEST)
    assert [round(frame.earlier, 3) for frame in heard] == [5.0, 0.0]
    listener.connection_lost(None)
    listener.lost.exception()


@pytest.mark.asyncio
async def test_the_port_is_closed_however_listening_ends() -> None:
    closed: list[bool] = []

    class Port:
        async def open(self, factory: Any) -> Any:
            listener = factory()
            listener.data_received(REQUEST)
            listener.connection_lost(None)
            return SimpleNamespace(close=lambda: closed.append(True))

    port: Any = Port()
    with pytest.raises(LineDown):
        await listen(port, Decoder(find("hcp2").protocol.dialect()), lambda _: None)
    assert closed == [True]


# the command, with a port that is not opened


def test_options_of_a_port_reach_it(busmaster: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ports: list[Any] = []
    captured: list[dict[str, Any]] = []

    def noted(path: str | None, **fields: Any) -> Any:
        captured.append(fields)
        return capturing(None, port="")

    async def nothing(endpoint: Any, decoder: Decoder, report: Any, recorder: Any = None, clock: Any = None) -> None:
        ports.append(endpoint)
        for frame in decoder.feed(bytes.fromhex(HCP2), 1_700_000_000.25):
            report(frame)

    monkeypatch.setattr(monitor, "listen", nothing)
    monkeypatch.setattr(monitor, "capturing", noted)
    plain = busmaster("monitor", "/dev/ttyS0", "--protocol", "hcp2", "--baud", "9600")
    assert (plain.status, plain.err) == (0, "")
    assert plain.lines[0].endswith("-> node 255 read 105 (axis0.encoder)")
    assert ports == [SerialPort("/dev/ttyS0", baudrate=9600)]
    assert captured == [{"port": "/dev/ttyS0", "protocol": "hcp2"}]
    as_json = busmaster("monitor", "/dev/ttyS0?echo=1", "--protocol", "hcp2", "--json")
    assert json.loads(as_json.lines[0])["item"] == "105"
    assert captured[1]["port"] == "/dev/ttyS0", "without its options"


FILE = """
port = "/dev/ttyS0?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 255
points.force = { item = "105", factor = 0.001, precision = 1 }
points.limit = { item = "1" }
[groups.first]
period = 0.01
points = ["winder/limit"]
[groups.second]
period = 0.01
points = ["winder/force"]
[outputs.jsonl]
path = "FOLDER/line.jsonl"
[outputs.sqlite]
path = "FOLDER/line.sqlite"
"""


@pytest.mark.parametrize("as_json", [False, True])
def test_a_file_prints_the_values_of_each_of_its_groups_and_the_counts_of_each_output(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, as_json: bool
) -> None:
    path = tmp_path / "line.toml"
    path.write_text(FILE.replace("FOLDER", str(tmp_path)))
    captured: list[tuple[str | None, dict[str, Any]]] = []

    def noted(file: str | None, **fields: Any) -> Any:
        captured.append((file, fields))
        return capturing(None, port="")

    async def passing(endpoint: Any, decoder: Decoder, report: Any, recorder: Any = None, clock: Any = None) -> None:
        async with asyncio.timeout(PATIENCE):
            while not printed:
                for frame in decoder.feed(bytes.fromhex(HCP2), clock()):
                    report(frame)
                await asyncio.sleep(0.005)
        raise LineDown("the line was closed", hint="")

    printed: list[str] = []
    monkeypatch.setattr(monitor, "emit_all", printed.extend)
    monkeypatch.setattr(monitor, "listen", passing)
    monkeypatch.setattr(monitor, "capturing", noted)
    done = busmaster("monitor", str(path), *(["--json"] * as_json), "--capture", "line.pcapng")
    assert done.status == 1
    if as_json:
        fields = json.loads(printed[0])
        assert fields["samples"]["winder/force"]["value"] == pytest.approx(4.096)
        assert fields["group"] == "second"
    else:
        moment, key, value = printed[0].split()
        assert (key, value) == ("winder/force", "4.1")
        assert abs(datetime.now(UTC) - datetime.fromisoformat(moment)).days == 0
    assert captured == [("line.pcapng", {"port": "/dev/ttyS0", "protocol": "hcp2"})]
    assert "sqlite: " in done.err
    assert "jsonl: " in done.err


def test_a_rate_beside_a_file_is_wrong_usage(busmaster: Command, tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(FILE)
    for option in (("--baud", "9600"), ("--protocol", "hcp2")):
        done = busmaster("monitor", str(path), *option)
        assert done.status == 2
        assert "leave out --protocol and --baud" in done.err


@contextmanager
def line_that_says(data: bytes) -> Iterator[str]:
    """A serial server behind which a line carries these bytes, then goes away."""
    with create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(data)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"
        thread.join()


def test_the_command_from_end_to_end(tmp_path: Path) -> None:
    capture = tmp_path / "line.pcapng"
    with line_that_says(bytes.fromhex(HCP2)) as port:
        arguments = ["monitor", port, "--protocol", "microflex", "--json", "--capture", str(capture)]
        done = subprocess.run(
            [sys.executable, "-m", "busmaster", *arguments],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    assert [json.loads(line)["item"] for line in done.stdout.splitlines()] == ["105", "105"]
    assert done.returncode == 1
    assert done.stderr.startswith("busmaster: the line was closed")
    with capture.open("rb") as file:
        packets = list(read_packets(file))
    assert [(packet.protocol, packet.node, packet.outcome) for packet in packets] == [
        ("microflex", 255, Outcome.NONE),
        ("microflex", 255, Outcome.OK),
    ]


def test_a_rate_that_no_device_of_the_protocol_has_is_said() -> None:
    with line_that_says(bytes.fromhex(MSC)) as port:
        arguments = ["monitor", f"{port}?baudrate=4800", "--protocol", "msc"]
        done = subprocess.run(
            [sys.executable, "-m", "busmaster", *arguments],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    assert "flags" in done.stdout
    assert done.stderr.splitlines()[0].endswith("MSC nodes support only 9600 baud, not 4800")
