"""The shipped dissector, run by the real tshark on captures of every command of every protocol."""

from __future__ import annotations

import os
import random
import re
import shutil
import struct
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from busmaster.capture import DISSECTOR, pcapng
from busmaster.capture.pcapng import Outcome, Packet, PcapngWriter
from busmaster.contract.frames import Direction
from busmaster.protocols._comms.elements import Element
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.comms_array import ELEMENTS as CONTROLLER
from busmaster.protocols.hcp2.microflex import ELEMENTS as DRIVE
from busmaster.registry import kinds
from tests.capture.hearing import HOST, NODE, sender_of, vectors
from tests.patience import PATIENCE

pytestmark = pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")

START = 1_700_000_000_000_000
FIELDS = ("_ws.col.Protocol", "_ws.col.Info", "busmaster.node", "busmaster.checksum.status", "busmaster.value")
EXPERT = "_ws.expert.message"


def dissect(folder: Path, packets: list[Packet], *fields: str) -> list[list[str]]:
    """The fields of each packet, as tshark prints them."""
    path = folder / "line.pcapng"
    write_capture(path, packets)
    names = [argument for field in fields for argument in ("-e", field)]
    command = ["tshark", "-X", f"lua_script:{DISSECTOR}", "-r", str(path), "-T", "fields", "-E", "separator=\t", *names]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
    assert "Lua" not in done.stderr, done.stderr
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    assert len(rows) == len(packets)
    return rows


def write_capture(path: Path, packets: list[Packet]) -> None:
    with path.open("wb") as file:
        writer = PcapngWriter(file, port="COM1")
        for packet in packets:
            writer.write(packet)


def packet(at: int, protocol: str, sender: Direction, frame: str, node: int | None = None) -> Packet:
    return Packet(START + at * 1000, protocol, sender, bytes.fromhex(frame), node)


FLAGS_REPLY = "02 03 00 27 00 00 52 46 4C 41 47 53 2C 01 02 00 80" + " 00" * 27 + " 80 03 18"
BLOCK = bytes(range(32))
BREAD_BODY = b"\x01\x00\x86\x00\x00BREAD," + b"".join(bytes((0, 0, 0, n)) for n in BLOCK)
BREAD_REPLY = b"\x02" + BREAD_BODY + sum(BREAD_BODY).to_bytes(2, "big")
BWRITE_BODY = b"\x01\x00\x89\x00\x00BWRITE,\x07\xd8" + b"".join(bytes((0, 0, 0, n)) for n in BLOCK)
BWRITE = b"\x02" + BWRITE_BODY + sum(BWRITE_BODY).to_bytes(2, "big")
VALUES = ",".join(map(str, range(32)))

CONVERSATIONS: dict[str, list[tuple[Direction, str, str, str, str, str]]] = {
    # frame, what the dissector says of it, node, checksum, value
    "hcp": [
        (HOST, "04 44 44 02 39 39 05", "node 13 read element 99", "13", "", ""),
        (NODE, "02 39 39 2D 30 2E 30 30 30 31 03 31", "node 13 element 99 = -0.0001", "13", "good", "-0.0001"),
        (
            HOST,
            "04 32 32 02 30 31 31 32 33 2E 34 35 36 03 2B",
            "node 2 write element 1 = 123.456",
            "2",
            "good",
            "123.456",
        ),
        (NODE, "06", "node 2 ACK", "2", "", ""),
        (
            HOST,
            "04 30 30 02 31 30 31 32 33 34 2C 2D 34 35 2E 36 2C 31 31 2E 32 03 2E",
            "node 0 write element 10 = 1234,-45.6,11.2",
            "0",
            "good",
            "1234,-45.6,11.2",
        ),
        (NODE, "15", "node 0 NAK", "0", "", ""),
    ],
    "hcp2": [
        (HOST, "07 46 46 02 36 39 05 08", "node 255 read element 105 (axis0.encoder)", "255", "good", ""),
        (NODE, "02 36 39 34 30 39 36 03 07", "node 255 element 105 (axis0.encoder) = 4096", "255", "good", "4096"),
        (HOST, "07 30 31 02 44 45 35 03 34", "node 1 write element 222 (outputs) = 5", "1", "good", "5"),
        (NODE, "06", "node 1 ACK", "1", "", ""),
        (
            HOST,
            "07 30 37 02 37 36 2D 32 35 2E 35 03 36",
            "node 7 write element 118 (axis1.axis_error / MicroFlex speed_reference) = -25.5",
            "7",
            "good",
            "-25.5",
        ),
        (NODE, "15", "node 7 NAK", "7", "", ""),
    ],
    "microflex": [
        (HOST, "07 30 37 02 36 44 05 72", "node 7 read element 109 (status_word)", "7", "good", ""),
        (
            NODE,
            "02 36 44 31 39 32 03 4B",
            "node 7 element 109 (status_word) = 192 [hardware_enable|enabled]",
            "7",
            "good",
            "192",
        ),
        (
            HOST,
            "07 30 37 02 36 43 31 32 38 03 48",
            "node 7 write element 108 (command_word) = 128 [enable]",
            "7",
            "good",
            "128",
        ),
        (NODE, "06", "node 7 ACK", "7", "", ""),
        (
            HOST,
            "07 30 37 02 37 36 2D 32 35 2E 35 03 36",
            "node 7 write element 118 (speed_reference) = -25.5",
            "7",
            "good",
            "-25.5",
        ),
        (NODE, "06", "node 7 ACK", "7", "", ""),
    ],
    "mentor": [
        (HOST, "04 31 31 32 32 30 31 31 37 05", "node 12 read 01.17", "12", "", ""),
        (NODE, "02 30 31 31 37 2D 30 30 34 37 36 03 3C", "node 12 01.17 = -00476", "12", "good", "-476"),
        (HOST, "06", "node 12 next", "12", "", ""),
        (NODE, "02 30 31 31 38 2B 30 30 30 30 30 03 30", "node 12 01.18 = +00000", "12", "good", "0"),
        (HOST, "08", "node 12 previous", "12", "", ""),
        (NODE, "02 30 31 31 37 2D 30 30 34 37 36 03 3C", "node 12 01.17 = -00476", "12", "good", "-476"),
        (HOST, "15", "node 12 again", "12", "", ""),
        (NODE, "02 30 31 31 37 2D 30 30 34 37 36 03 3C", "node 12 01.17 = -00476", "12", "good", "-476"),
        (HOST, "04 31 31 32 32 31 37 32 33 05", "node 12 read 17.23", "12", "", ""),
        (NODE, "04", "node 12 EOT", "12", "", ""),
        (
            HOST,
            "04 31 31 34 34 02 30 31 31 37 2B 30 34 37 36 35 03 3F",
            "node 14 write 01.17 = +04765",
            "14",
            "good",
            "4765",
        ),
        (NODE, "06", "node 14 ACK", "14", "", ""),
        (
            HOST,
            "04 30 30 35 35 02 31 35 36 30 35 34 33 32 31 03 30",
            "node 5 write 15.60 = 54321",
            "5",
            "good",
            "54321",
        ),
        (NODE, "15", "node 5 NAK", "5", "", ""),
        (HOST, "04 32 32 33 33 02 30 34 32 36 30 31 03 22", "node 23 write 04.26 = 01", "23", "good", "1"),
        (HOST, "04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F", "node 0 write 01.17 = +0000", "0", "good", "0"),
    ],
    "msc": [
        (HOST, "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74", "node 1 DREAD 2008", "1", "good", ""),
        (NODE, "06", "node 1 ACK", "1", "", ""),
        (NODE, "02 01 00 0A 00 00 44 52 45 41 44 2C FF FF FF FF 05 93", "node 1 DREAD 2008 = -1", "1", "good", "-1"),
        (HOST, "15", "node 1 NAK", "1", "", ""),
        (
            NODE,
            "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D",
            "node 1 DREAD 2008 = 1234",
            "1",
            "good",
            "1234",
        ),
        (HOST, "06", "node 1 ACK", "1", "", ""),
        (
            HOST,
            "02 01 00 0D 00 00 44 57 52 49 54 45 2C 07 D8 00 00 04 D2 03 BE",
            "node 1 DWRITE 2008 = 1234",
            "1",
            "good",
            "1234",
        ),
        (NODE, "15", "node 1 NAK", "1", "", ""),
        (HOST, "02 01 00 08 00 00 42 52 45 41 44 2C 07 D8 02 72", "node 1 BREAD 2008", "1", "good", ""),
        (NODE, BREAD_REPLY.hex(), "node 1 BREAD 2008 = 0,1,2,3,... (32)", "1", "good", VALUES),
        (HOST, BWRITE.hex(), "node 1 BWRITE 2008 = 0,1,2,3,... (32)", "1", "good", VALUES),
        (HOST, "02 02 00 08 00 00 53 46 4C 41 47 2C 00 05 01 A8", "node 2 SFLAG flag 5", "2", "good", ""),
        (HOST, "02 02 00 08 00 00 43 46 4C 41 47 2C 00 05 01 98", "node 2 CFLAG flag 5", "2", "good", ""),
        (HOST, "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 FF 02 AE", "node 15 RFLAG flag 255", "15", "good", ""),
        (NODE, "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 01 01 B0", "node 15 RFLAG flag 255 = 1", "15", "good", "1"),
        (HOST, "02 03 00 07 00 00 52 46 4C 41 47 53 2C 01 F5", "node 3 RFLAGS", "3", "good", ""),
        (NODE, FLAGS_REPLY, "node 3 RFLAGS = 0,9,31,255", "3", "good", ""),
        (HOST, "02 01 00 07 00 00 52 51 53 54 41 54 2C 02 13", "node 1 RQSTAT", "1", "good", ""),
        (
            NODE,
            "02 01 00 0F 00 00 52 51 53 54 41 54 2C 00 41 00 00 00 00 00 00 02 5C",
            "node 1 RQSTAT = 65 [PROGRAM_RUNNING|AUTO_START_ENABLED]",
            "1",
            "good",
            "65",
        ),
    ],
    "dc104": [
        (HOST, "02 AA AA 54", "read parameter 170", "", "good", ""),
        (NODE, "02 AA 00 05 AF", "parameter 170 = 5", "", "good", "5"),
        (HOST, "02 55 02 FF FF 55", "write parameter 2 = 65535", "", "good", "65535"),
        (NODE, "06", "ACK", "", "", ""),
        (HOST, "02 AA 6B 15", "read parameter 107", "", "good", ""),
        (NODE, "15", "NAK", "", "", ""),
    ],
}
TITLES = {"hcp": "HCP", "hcp2": "HCP2", "microflex": "MicroFlex", "msc": "MSC", "mentor": "Mentor", "dc104": "DC104"}


@pytest.mark.slow
def test_every_command_of_every_protocol_is_put_into_words(tmp_path: Path) -> None:
    packets: list[Packet] = []
    expected: list[list[str]] = []
    for protocol, frames in CONVERSATIONS.items():
        for sender, frame, *rest in frames:
            packets.append(packet(len(packets), protocol, sender, frame))
            expected.append([TITLES[protocol], *rest])
    assert dissect(tmp_path, packets, *FIELDS) == expected


@pytest.mark.parametrize(("protocol", "elements"), [("hcp2", CONTROLLER), ("microflex", DRIVE)])
def test_elements_are_called_what_the_package_calls_them(
    tmp_path: Path, protocol: str, elements: Mapping[str, Element[object]]
) -> None:
    reads = [hcp2.Read(element.number).open(1, hcp2.PROFILE.timings).request for element in elements.values()]
    rows = dissect(tmp_path, [Packet(START, protocol, HOST, read) for read in reads], "busmaster.name")
    assert [name.partition(" / ")[0] for (name,) in rows] == list(elements)


def test_a_bad_checksum_is_flagged_and_a_good_one_is_not(tmp_path: Path) -> None:
    frames = [(protocol, sender_of(name), raw) for protocol, name, raw in vectors()]
    frames = [frame for frame in frames if not is_unchecked(*frame)]
    spoilt = [(protocol, sender, raw[:-1] + bytes((raw[-1] ^ 1,))) for protocol, sender, raw in frames]
    packets = [Packet(START, protocol, sender, raw) for protocol, sender, raw in frames + spoilt]
    rows = dissect(tmp_path, packets, "busmaster.checksum.status", EXPERT)
    good, bad = rows[: len(frames)], rows[len(frames) :]
    assert {status for status, _ in good} == {"good"}
    assert {status for status, _ in bad} == {"bad"}
    assert not any("Bad checksum" in message for _, message in good)
    assert all("Bad checksum" in message for _, message in bad)


def is_unchecked(protocol: str, sender: Direction, raw: bytes) -> bool:
    """Reads of HCP and Mentor II carry no checksum: the last byte is ENQ."""
    return sender is HOST and raw[-1] == 5 and (protocol == "mentor" or (protocol == "hcp" and len(raw) == 7))


def test_replies_are_tied_to_requests_and_what_is_odd_is_noted(tmp_path: Path) -> None:
    request = "07 30 32 02 30 31 05 04"
    packets = [
        packet(0, "hcp2", HOST, request),
        packet(3, "hcp2", NODE, "02 30 31 35 03 37"),
        packet(4, "hcp2", HOST, request),
        packet(104, "hcp2", NODE, "", 2),
        packet(105, "hcp2", HOST, request),
        packet(110, "hcp2", NODE, "02 30 32 35 03 34"),
        packet(111, "hcp2", NODE, "02 30 31"),
        packet(200, "hcp2", NODE, "15"),
        packet(201, "mentor", HOST, "04 31 31 32 32 31 37 32 33 05"),
        packet(202, "mentor", NODE, "04"),
    ]
    packets[3].outcome, packets[7].outcome = Outcome.NO_REPLY, Outcome.UNEXPECTED
    packets[3].comment = "read element 1: node 2: no reply within 100 ms"
    fields = ("_ws.col.Info", "busmaster.request_in", "busmaster.time", EXPERT, "frame.comment", "frame.p2p_dir")
    rows = dissect(tmp_path, packets, *fields)
    assert rows[1] == ["node 2 element 1 = 5", "1", "0.003", "", "", "1"]
    assert rows[3][0] == "node 2 no reply"
    assert "No reply" in rows[3][3]
    assert rows[3][4] == packets[3].comment
    assert "Not what was asked: element 1" in rows[5][3]
    assert rows[6][0] == "node 2 no frame (3 bytes)"
    assert "cut short" in rows[6][3]
    assert rows[7][:3] == ["NAK", "", ""]
    assert "No request asked for this" in rows[7][3]
    assert "No such parameter" in rows[9][3]
    assert rows[0][5] == "0"


def test_a_reply_is_tied_to_the_request_of_its_own_exchange_and_to_no_other(tmp_path: Path) -> None:
    packets = [
        replace(packet(0, "hcp2", HOST, "07 30 32 02 30 31 05 04"), transaction=70_000, attempt=2),
        replace(packet(3, "hcp2", NODE, "02 30 31 35 03 37"), transaction=70_000, attempt=2, outcome=Outcome.AMBIGUOUS),
        replace(packet(4, "hcp2", NODE, "02 30 31 35 03 37"), transaction=70_001, attempt=1),
        packet(5, "hcp2", NODE, "02 30 31 35 03 37"),
    ]
    fields = ("busmaster.transaction", "busmaster.attempt", "busmaster.request_in", EXPERT)
    told = "Not taken for an answer: not believed"
    assert dissect(tmp_path, packets, *fields) == [
        ["70000", "2", "", ""],
        ["70000", "2", "1", told],
        ["70001", "1", "", ""],
        ["", "", "", ""],
    ]


@pytest.mark.slow
def test_a_capture_of_an_older_version_reads_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packets = [
        packet(0, "hcp2", HOST, "07 30 32 02 30 31 05 04"),
        packet(3, "hcp2", NODE, "02 30 31 35 03 37"),
    ]
    fields = (*FIELDS, "busmaster.request_in")
    today = dissect(tmp_path, packets, *fields)

    class Short:
        """The header that ended before the number of the request."""

        def pack(self, _version: int, *head: int) -> bytes:
            return struct.pack(">BBBBH", 1, *head[:4])

    monkeypatch.setitem(pcapng._HEADERS, pcapng.HEADER_VERSION, Short())
    assert dissect(tmp_path, packets, *fields) == today
    assert today[1][-1] == "1"


@pytest.mark.slow
def test_no_bytes_however_garbled_upset_it(tmp_path: Path) -> None:
    draw = random.Random(4)
    frames = vectors()
    packets: list[Packet] = []
    for _ in range(3000):
        protocol, _, raw = draw.choice(frames)
        garbled = bytearray(raw[: draw.randrange(len(raw) + 1)] if draw.random() < 0.4 else raw)
        for _ in range(draw.randrange(4) if garbled else 0):
            garbled[draw.randrange(len(garbled))] = draw.randrange(256)
        spoken = protocol if draw.random() < 0.8 else draw.choice(["", *kinds()])
        sender, outcome = draw.choice(list(Direction)), draw.choice(list(Outcome))
        packets.append(Packet(START, spoken, sender, bytes(garbled), draw.choice([None, 1]), outcome))
    rows = dissect(tmp_path, packets, EXPERT)
    assert not [message for (message,) in rows if "Lua" in message]


def test_a_character_with_bit_7_set_acknowledges_where_that_bit_is_parity_and_nowhere_else(tmp_path: Path) -> None:
    asked = {
        "hcp2": "07 30 31 02 44 45 35 03 34",
        "msc": "02 01 00 08 00 00 53 46 4C 41 47 2C 00 05 01 A7",
        "dc104": "02 55 02 FF FF 55",
        "mentor": "04 31 31 34 34 02 30 31 31 37 2B 30 34 37 36 35 03 3F",
    }
    packets: list[Packet] = []
    for protocol, request in asked.items():
        packets += [packet(len(packets), protocol, HOST, request), packet(len(packets) + 1, protocol, NODE, "86")]
    rows = dissect(tmp_path, packets, "busmaster.ack", EXPERT)
    assert [acknowledged for acknowledged, _ in rows[1::2]] == ["", "", "", "ACK"]
    assert ["cut short" in told for _, told in rows[1::2]] == [True, True, True, False]


def test_a_short_command_behind_another_protocols_request_is_tied_to_nothing(tmp_path: Path) -> None:
    packets = [
        packet(0, "hcp2", HOST, "07 30 32 02 30 31 05 04"),
        packet(1, "mentor", HOST, "06"),
        packet(2, "mentor", NODE, "02 30 31 31 38 2B 30 30 30 30 30 03 30"),
    ]
    rows = dissect(tmp_path, packets, "_ws.col.Info", "busmaster.request_in", EXPERT)
    assert rows[1:] == [["next", "", ""], ["01.18 = +00000", "", ""]]


def test_what_comes_after_its_request_was_given_up_is_called_late(tmp_path: Path) -> None:
    request, reply = "07 30 32 02 30 31 05 04", "02 30 31 35 03 37"
    packets = [
        packet(0, "hcp2", HOST, request),
        replace(packet(100, "hcp2", NODE, "", 2), outcome=Outcome.NO_REPLY),
        replace(packet(120, "hcp2", NODE, "02 30 32 35 03 34"), outcome=Outcome.UNEXPECTED),
        replace(packet(130, "hcp2", NODE, reply), outcome=Outcome.UNEXPECTED),
        replace(packet(140, "hcp2", NODE, reply), outcome=Outcome.UNEXPECTED),
        packet(200, "hcp2", HOST, request),
        packet(205, "hcp2", NODE, reply),
    ]
    rows = dissect(tmp_path, packets, "busmaster.late", "busmaster.time", "busmaster.request_in", EXPERT)
    assert rows[3][:3] == ["1", "0.13", "1"]
    assert "A late reply to the request in packet 1" in rows[3][3]
    assert [row[:3] for row in (rows[2], rows[4])] == [["", "", ""]] * 2
    assert rows[6][:3] == ["", "0.005", "6"]


@pytest.mark.slow
def test_the_profile_shows_times_of_replies_and_colours_what_went_wrong(tmp_path: Path) -> None:
    packets = [
        packet(0, "hcp2", HOST, "07 30 32 02 30 31 05 04"),
        packet(3, "hcp2", NODE, "02 30 31 35 03 37"),
        packet(4, "hcp2", HOST, "07 30 32 02 30 31 05 04"),
        replace(packet(104, "hcp2", NODE, "", 2), outcome=Outcome.NO_REPLY),
        replace(packet(130, "hcp2", NODE, "02 30 31 35 03 37"), outcome=Outcome.UNEXPECTED),
        replace(packet(200, "hcp2", HOST, "07 30 32 02 30 31 05 04"), transaction=1, attempt=2),
        replace(packet(203, "hcp2", NODE, "02 30 31 35 03 38"), outcome=Outcome.GARBLED, transaction=1, attempt=2),
        replace(packet(210, "hcp2", NODE, "15"), outcome=Outcome.UNEXPECTED),
    ]
    write_capture(tmp_path / "line.pcapng", packets)
    shutil.copytree(DISSECTOR.parent / "profile", tmp_path / "profiles" / "busmaster")
    command = ["tshark", "-C", "busmaster", "-X", f"lua_script:{DISSECTOR}", "-r", str(tmp_path / "line.pcapng")]
    environment = {**os.environ, "WIRESHARK_CONFIG_DIR": str(tmp_path)}

    def told(*options: str) -> list[str]:
        done = subprocess.run(
            [*command, *options], capture_output=True, text=True, check=True, timeout=PATIENCE, env=environment
        )
        assert not re.search("Lua|olor|column|preference", done.stderr), done.stderr
        return done.stdout.splitlines()

    lines = told()
    assert "0.003" in lines[1]
    assert "0.126" in lines[4]
    rules = told("-T", "fields", "-e", "frame.coloring_rule.name", "-e", "frame.number", "--color")
    names = [re.sub("\x1b\\[[0-9;]*[mK]", "", line).partition("\t")[0] for line in rules]
    assert names == [
        "", "", "", "No reply", "Late reply", "Another attempt", "Garbled, or a bad checksum", "Refused",
    ]  # fmt: skip
