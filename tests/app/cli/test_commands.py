"""read, write, poll and scan, as a person types them, against an emulated line on a TCP port."""

from __future__ import annotations

import json
import socket
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest

from busmaster.capture.pcapng import read_packets
from busmaster.contract.frames import Direction
from busmaster.emulator.serve import TcpServer
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.registry import kinds
from tests.app.cli.conftest import Command, ended_once, serve, without_time

HCP2 = ("--protocol", "hcp2")


def test_what_was_written_is_read(busmaster: Command, controllers: TcpServer) -> None:
    wrote = busmaster("write", controllers.path, *HCP2, "--node", "5", "1=123.456")
    assert (wrote.status, wrote.out, wrote.err) == (0, "1 ok\n", "")
    read = busmaster("read", controllers.path, *HCP2, "--node", "5", "1")
    assert (read.status, read.out, read.err) == (0, "1 123.456\n", "")


def test_several_items_are_a_line_each_and_json_an_object_a_line(busmaster: Command, controllers: TcpServer) -> None:
    assert busmaster("write", controllers.path, *HCP2, "--node", "2", "10=12.5,-0.0001,1234").lines == [
        "10 ok",
        "11 ok",
        "12 ok",
    ]
    assert busmaster("read", controllers.path, *HCP2, "--node", "2", "10", "11", "12", "axis0.idle").lines == [
        "10 12.5",
        "11 -0.0001",
        "12 1234",
        "axis0.idle 1",
    ]
    wrote = busmaster("write", controllers.path, *HCP2, "--node", "2", "10=12.5,-0.0001,1234", "1=5", "--json")
    assert list(map(without_time, wrote.lines)) == [
        {"node": 2, "item": "10", "items": ["10", "11", "12"], "ok": True},
        {"node": 2, "item": "1", "ok": True},
    ]
    read = busmaster("read", controllers.path, *HCP2, "--node", "2", "10", "12", "--json")
    assert list(map(without_time, read.lines)) == [
        {"node": 2, "item": "10", "value": 12.5},
        {"node": 2, "item": "12", "value": 1234},
    ]


def test_a_write_can_be_verified_and_says_so_in_json(busmaster: Command, controllers: TcpServer) -> None:
    wrote = busmaster("write", controllers.path, *HCP2, "--node", "3", "1=0.12345", "outputs=5", "--verify", "--json")
    assert wrote.err == ""
    assert list(map(without_time, wrote.lines)) == [
        {"node": 3, "item": "1", "ok": True},
        {"node": 3, "item": "outputs", "ok": True},
    ]


def test_a_node_that_is_not_there_is_one_clear_line_and_status_1(busmaster: Command, controllers: TcpServer) -> None:
    read = busmaster("read", controllers.path, *HCP2, "--node", "77", "1")
    assert (read.status, read.out) == (1, "")
    assert read.err.startswith("busmaster: node 77: no reply within 150 ms, 3 attempts; ")
    assert read.err.count("\n") == 1


def test_timeout_and_retries_are_the_callers_to_choose(busmaster: Command, controllers: TcpServer) -> None:
    read = busmaster("read", controllers.path, *HCP2, "--node", "77", "1", "--timeout", "20", "--retries", "0")
    max_reply_delay = "150 ms"  # a late reply is right, too: the window says from when on it is late
    assert read.err.startswith(f"busmaster: node 77: no reply within {max_reply_delay}, 1 attempt")


def test_a_refusal_names_the_command(busmaster: Command, controllers: TcpServer) -> None:
    wrote = busmaster("write", controllers.path, *HCP2, "--node", "5", "100=1")
    assert (wrote.status, wrote.out) == (1, "")
    assert wrote.err.startswith("busmaster: node 5: ")
    assert "write element 100 = 1" in wrote.err


@pytest.mark.parametrize(
    ("assignment", "complaint"),
    [
        ("1=abc", "'abc' is not a number"),
        ("1=nan", "finite"),
        ("1=1e30", "20 characters"),
        ("1", "ITEM=VALUE"),
        ("axis0.position=1", "axis0.position is read-only"),
        ("axis9.position=1", "no such item 'axis9.position'"),
        ("256=1", "element"),
    ],
)
def test_a_bad_assignment_is_status_2_and_nothing_is_sent(busmaster: Command, assignment: str, complaint: str) -> None:
    """Even what stands before it on the command line: nobody listens on this port, and nobody is asked to."""
    wrote = busmaster("write", "socket://127.0.0.1:1", *HCP2, "--node", "5", "2=1", assignment)
    assert (wrote.status, wrote.out) == (2, "")
    assert complaint in wrote.err
    assert wrote.err.startswith("busmaster: ")
    assert wrote.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("raed", "PORT"), "did you mean 'read'?"),
        (("read", "PORT", "1"), "protocol missing; use --protocol P, or a LINE.toml"),
        (("scan", "PORT"), "missing option '--protocol'"),
        (("read", "PORT", "--protocol", "hcp3", "1"), "no such protocol 'hcp3'; did you mean 'hcp'?"),
        (("read", "PORT", *HCP2, "1"), "hcp2 needs a node address, 0-255"),
        (("read", "PORT", *HCP2, "--node", "256", "1"), "256"),
        (("read", "PORT", "--protocol", "hcp", "--node", "16", "1"), "address 16 does not exist"),
        (("read", "PORT", "--protocol", "dc104", "--node", "1", "1"), "dc104 has no node addresses"),
        (("read", "PORT", *HCP2, "--node", "1"), "missing argument 'ITEM...'"),
        (("read", "PORT", *HCP2, "--node", "1", "axis0.positoin"), "did you mean 'axis0.position'?"),
        (("read", "PORT", *HCP2, "--node", "1", "1", "--timeout", "0"), "a time must be above 0"),
        (("read", "PORT", *HCP2, "--node", "1", "1", "--chain"), "--chain is only for ct-ansi and ei-bisynch"),
        (("read", "PORT?baud=3", *HCP2, "--node", "1", "1"), "did you mean 'baudrate'?"),
        (("read", "rfc2217://host", *HCP2, "--node", "1", "1"), "is not of the form rfc2217://HOST:PORT"),
        (("read", "host:5020", *HCP2, "--node", "1", "1"), "write a TCP port as socket://host:5020"),
        (("read", "PORT", *HCP2, "--node", "one", "1"), "'one' is not a valid whole number"),
        (("read", "PORT", *HCP2, "--node", "1", "1", "--timeout", "9e9"), "at most 60000 ms"),
        (("read", "PORT", "--protcol", "hcp2", "1"), "no such option '--protcol': did you mean '--protocol'?\n"),
        (("scan", "PORT", "--protocol", "mentor", "--nodes", "1,0"), "is the broadcast address"),
        (
            ("poll", "PORT", *HCP2, "--nodes", "8-1", "--items", "1", "--period", "1"),
            "the range 8-1 is descending; write 1-8",
        ),
        (("poll", "PORT", *HCP2, "--nodes", "1;2", "--items", "1", "--period", "1"), "like 1-8,255"),
        (("poll", "PORT", *HCP2, "--nodes", "1", "--items", ",", "--period", "1"), "at least one item"),
        (("poll", "PORT", *HCP2, "--nodes", "1", "--items", "1", "--period", "-1"), "a time must be above 0"),
        (("emulate", *HCP2, "--tcp", "5020"), "HOST:PORT"),
        (("emulate", *HCP2, "--pty", "--tcp", "127.0.0.1:0"), "exclude each other"),
        (("emulate", *HCP2, "--fault", "losst=1"), "did you mean 'lost'?"),
        (("emulate", *HCP2, "--reply-delay", "5-x"), "as 2 or 50-100"),
        (("emulate", "--protocol", "mentor", "--nodes", "0-3"), "is the broadcast address"),
    ],
)
def test_wrong_usage_is_one_line_that_helps_and_status_2(
    busmaster: Command, arguments: tuple[str, ...], complaint: str
) -> None:
    outcome = busmaster(*arguments)
    assert (outcome.status, outcome.out) == (2, "")
    assert complaint in outcome.err
    assert outcome.err.startswith("busmaster: ")
    assert outcome.err.count("\n") == 1


def test_help_and_version_go_to_standard_output(busmaster: Command) -> None:
    for arguments in (("--help",), ("read", "--help"), ("--version",)):
        outcome = busmaster(*arguments)
        assert (outcome.status, outcome.err) == (0, "")
        assert "busmaster" in outcome.out
    assert busmaster().status == 2


@pytest.mark.parametrize("command", ["read", "write", "poll"])
def test_help_names_the_items_of_every_protocol(busmaster: Command, command: str) -> None:
    listed = {line.split()[0] for line in busmaster(command, "--help").out.partition("ITEM, by")[2].splitlines()[1:]}
    assert listed >= set(kinds())


def test_help_names_every_element_of_the_maps(busmaster: Command) -> None:
    words = set(busmaster("read", "--help").out.replace(":", " ").split())
    assert words >= set(MicroFlexDrive.elements)
    assert words >= {name.rpartition(".")[2].rstrip("1234567") for name in Hcp2Controller.elements} - {"adc"}


def test_a_port_that_is_not_there_is_status_1(busmaster: Command, tmp_path: Path) -> None:
    for port in (str(tmp_path / "absent"), "socket://127.0.0.1:1"):
        outcome = busmaster("read", port, *HCP2, "--node", "1", "1")
        assert (outcome.status, outcome.out) == (1, "")
        assert outcome.err.startswith("busmaster: ")
        assert outcome.err.count("\n") == 1


def test_a_tcp_port_that_is_taken_is_said_so(busmaster: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        outcome = busmaster("emulate", *HCP2, "--tcp", address)
    assert (outcome.status, outcome.out) == (1, "")
    assert f"cannot serve on {address}: Address already in use; use another port" in outcome.err


@pytest.mark.slow
def test_poll_prints_a_line_a_value_and_a_summary_on_standard_error(controllers: TcpServer) -> None:
    options = ("--nodes", "1-2", "--items", "1,axis0.idle", "--period", "0.02")
    began = datetime.now(UTC)
    polled = ended_once(lambda lines: len(lines) == 12, "poll", controllers.path, *HCP2, *options)
    assert polled.status == 130
    moment, key, value = polled.lines[3].split()
    assert (key, value) == ("2/axis0.idle", "1")
    assert began < datetime.fromisoformat(moment) < datetime.now(UTC)
    summary = polled.err.splitlines()
    assert "cycles" in summary[0]
    assert "p99" in summary[0]
    assert [line.split(":")[1].strip() for line in summary[1:]] == ["node 1", "node 2"]


def test_poll_in_json_has_a_line_a_cycle_with_times_since_the_start(controllers: TcpServer) -> None:
    options = ("--nodes", "1,99", "--items", "outputs", "--period", "0.02", "--json")
    began = time.monotonic()
    polled = ended_once(lambda lines: len(lines) == 2, "poll", controllers.path, *HCP2, *options)
    cycles = [json.loads(line) for line in polled.lines]
    assert [cycle["cycle"] for cycle in cycles] == list(range(1, len(cycles) + 1))
    last = cycles[-1]
    assert list(last) == ["group", "cycle", "due", "started", "finished", "missed", "samples", "time"]
    assert abs(datetime.now(UTC) - datetime.fromisoformat(last["time"])).days == 0
    assert 0 <= last["due"] <= last["started"] <= last["finished"] < time.monotonic() - began
    assert last["samples"]["1/outputs"] == {"value": 0, "quality": "good", "error": None, "late": False}
    silent = last["samples"]["99/outputs"]
    assert sorted(silent) == ["error", "hint", "late", "quality", "value"]
    assert (silent["value"], silent["quality"]) == (None, "bad")
    assert silent["error"]
    assert silent["hint"]


def test_poll_that_ends_without_a_value_ends_with_1(busmaster: Command, controllers: TcpServer) -> None:
    options = ("--nodes", "99", "--items", "1", "--period", "0.05", "--seconds", "0.2", "--json")
    polled = busmaster("poll", controllers.path, *HCP2, *options)
    assert polled.status == 1
    assert "no value was received" in polled.err
    assert "p50" not in polled.err, "there is no latency of a node that never answered"


def test_poll_ends_with_0_if_any_of_its_nodes_has_replied(busmaster: Command, controllers: TcpServer) -> None:
    options = ("--nodes", "1,99", "--items", "1", "--period", "0.05", "--seconds", "0.4", "--plain")
    polled = busmaster("poll", controllers.path, *HCP2, *options)
    assert polled.status == 0, polled.err
    assert "no value was received" not in polled.err


def test_scan_prints_a_line_for_each_node_that_answers(busmaster: Command, controllers: TcpServer) -> None:
    found = busmaster("scan", controllers.path, *HCP2, "--nodes", "6-7,200", "--timeout", "300")
    assert (found.status, found.lines) == (0, ["6 read element 1: 0", "7 read element 1: 0"])
    found = busmaster("scan", controllers.path, *HCP2, "--nodes", "7", "--json")
    assert without_time(found.out) == {"node": 7, "value": 0, "answer": "read element 1: 0"}


@pytest.mark.slow
def test_a_scan_of_all_addresses_warns_of_none_of_them(busmaster: Command) -> None:
    with serve("mentor", 3) as server:
        found = busmaster("scan", server.path, "--protocol", "mentor", "--nodes", "2-3", "--timeout", "300")
    assert (found.status, found.err) == (0, "")
    assert [line.split()[0] for line in found.lines] == ["3"]


def test_any_command_can_be_captured(busmaster: Command, controllers: TcpServer, tmp_path: Path) -> None:
    file = tmp_path / "line.pcapng"
    read = busmaster("read", controllers.path, *HCP2, "--node", "8", "1", "2", "--capture", str(file))
    assert (read.status, read.err) == (0, "")
    with file.open("rb") as capture:
        packets = list(read_packets(capture))
    assert [packet.direction for packet in packets] == [Direction.HOST, Direction.NODE] * 2
    assert packets[0].frame == bytes.fromhex("07 30 38 02 30 31 05 0E")

    outcome = busmaster("read", controllers.path, *HCP2, "--node", "8", "1", "--capture", str(tmp_path / "no" / "dir"))
    assert (outcome.status, outcome.out) == (2, "")
    assert "No such file or directory" in outcome.err


def test_words_are_printed_with_the_names_of_their_bits(busmaster: Command) -> None:
    with serve("microflex", 7) as server:
        microflex = ("--protocol", "microflex", "--node", "7")
        assert busmaster("write", server.path, *microflex, "command_word=0x80").out == "command_word ok\n"
        assert (
            busmaster("read", server.path, *microflex, "status_word").out == "status_word 192 HARDWARE_ENABLE|ENABLED\n"
        )
        refused = busmaster("write", server.path, *microflex, "speed_reference=10,20")
        assert (refused.status, refused.out) == (2, "")
        read = busmaster("read", server.path, *microflex, "status_word", "--json")
        assert without_time(read.out) == {
            "node": 7,
            "item": "status_word",
            "value": 192,
            "names": ["HARDWARE_ENABLE", "ENABLED"],
        }
