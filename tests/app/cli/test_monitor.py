"""`busmaster monitor`: lines and JSON of what passes, from a line that nobody asks anything."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from socket import create_server
from typing import Any

import pytest

from busmaster.app.cli.monitor import Listener, json_text, plain_text
from busmaster.capture.decode import Decoder
from busmaster.capture.pcapng import Outcome, read_packets
from busmaster.contract.frames import Frame
from busmaster.errors import LineDown
from busmaster.registry import find
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
