"""The doctor's findings: on emulated lines in virtual time; as a command, on ptys and TCP ports.

A wrong baud rate cannot be had on a pty, whose speed is a number that nobody heeds: there the far end looks at the
number, and is deaf while it is another than its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import subprocess
import sys
import termios
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import anyio
import pytest
import serial

from busmaster.app.cli import doctor
from busmaster.app.cli.arguments import Connection
from busmaster.app.cli.doctor import patient_of
from busmaster.app.cli.progress import Bar
from busmaster.app.diagnostics import adapters, diagnosis, examination
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.examination import HARMLESS, Patient, examine, other_settings
from busmaster.app.diagnostics.probing import Outcome, Prober, opened
from busmaster.capture.pcapng import read_packets
from busmaster.contract.profile import LineSettings
from busmaster.contract.tap import Attempt, Tap
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.memory import MemoryPort, MemoryTransport
from busmaster.emulator.serve import PtyServer, TcpServer, serve_pty
from busmaster.ext import Mark
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import find, kinds, make_device
from busmaster.testing import run_in_virtual_time
from busmaster.transport import identity
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.serial_port import SerialPort
from tests.app.cli.conftest import Command, without_time
from tests.app.cli.conftest import Outcome as Ended
from tests.transport.fakes import plugged, without_rate
from tests.transport.rfc2217_server import RemotePort, rfc2217_server
from tests.transport.rs485_driver import FakeDriver
from tests.transport.usb import UsbTree

HCP2 = ("--protocol", "hcp2")
HCP2_SETTINGS = LineSettings(57600)


def line_of(protocol: str, devices: Iterable[Device], **options: object) -> Line:
    chance = random.Random(1)
    return Line(find(protocol).profile.line, devices, chance=chance, **options)  # type: ignore[arg-type]  # Line's own


def hcp2(address: int, delay: Delay | None = None, **faults: float) -> Device:
    device = make_device("hcp2", address, delay=delay)
    device.faults = Faults(**faults)
    return device


def examined(line: Line, addresses: Iterable[int], protocol: str = "hcp2", port: MemoryPort | None = None) -> Findings:
    """In virtual time. What is not in order must say what to do."""
    findings = Findings()
    patient = Patient(port or MemoryPort(line), protocol, addresses=tuple(addresses), named=True)
    run_in_virtual_time(examine(patient, findings.append))
    assert all(finding.advice for finding in findings if not finding.ok)
    return findings


class Findings(list[Finding]):
    def on(self, topic: str) -> Finding:
        (finding,) = [finding for finding in self if finding.topic == topic]
        return finding

    @property
    def wrong(self) -> set[str]:
        return {finding.topic for finding in self if not finding.ok}


@dataclass(frozen=True)
class Claiming(MemoryPort):
    """A port whose owner says of the echo whatever he likes."""

    claim: bool = False

    @property
    def echo(self) -> bool:
        return self.claim


class Chatterbox(Device):
    """Says the same again and again, whatever it hears."""

    def __init__(self, words: bytes) -> None:
        super().__init__(99)
        self.words = words
        self.wakeup = 0.0

    def hear_byte(self, byte: int, now: float) -> None:
        pass

    def wake(self, now: float) -> None:
        self.reply(self.words, now, 0.0)
        self.wakeup = now + 0.2


# A line in order


def test_on_a_line_in_order_every_node_is_measured_and_nothing_is_to_be_mended() -> None:
    findings = examined(line_of("hcp2", [hcp2(1), hcp2(2, Delay(0.010, 0.020))]), (1, 2))
    assert findings.wrong == set()
    assert [finding.topic for finding in findings] == [
        "open",
        "silence",
        "echo",
        "node 1",
        "node 2",
        "windows",
        "learning",
    ]
    assert (
        findings.on("node 1").what == "replies after 2.2 / 2.2 / 2.2 ms (least / median / p99 of 25): read element 1: 0"
    )
    assert findings.on("windows").what.endswith("set are 50 / 100 / 150 ms (late_after / window / max_reply_delay)")


@pytest.mark.parametrize("protocol", list(kinds()))
def test_every_protocol_is_asked_its_cheapest_read(protocol: str) -> None:
    address = find(protocol).profile.addresses[0]
    findings = examined(line_of(protocol, [make_device(protocol, address)]), (address,), protocol)
    assert findings.wrong == set()
    label = find(protocol).profile.label(address)
    assert str(find(protocol).profile.probe) in findings.on(label).what


def test_a_node_that_refuses_the_read_is_in_order_and_the_reason_is_named() -> None:
    findings = examined(line_of("modbus", [make_device("modbus", 4, size=0)]), (4,), "modbus")
    finding = findings.on(find("modbus").profile.label(4))
    assert finding.ok
    assert finding.what.endswith("; the device does not have this item")


def test_a_rate_that_no_device_of_the_protocol_has_is_a_note_and_nothing_to_fix() -> None:
    line = Line(LineSettings(19200), [EmulatedMsc(3)], chance=random.Random(1))
    findings = examined(line, (3,), "msc")
    assert findings.wrong == set()
    assert findings.on("open").advice == "MSC nodes support only 9600 baud, not 19200"


def test_a_node_is_left_with_nothing_unacknowledged() -> None:
    """MSC sends a packet again until the host ACKs it."""

    async def ask() -> None:
        async with opened(MemoryPort(line)) as wire:
            prober = Prober(wire, profile, profile.timings, profile.line.byte_time, echo=False)
            assert (await prober.ask(3)).outcome is Outcome.ANSWERED
            assert await wire.hear_all(5.0) == b""

    profile = find("msc").profile
    controller = EmulatedMsc(3)
    line = line_of("msc", [controller])
    run_in_virtual_time(ask())
    assert (controller.unacknowledged, controller.retransmitted) == (False, 0)


def test_settings_that_are_not_usual_are_noted_where_the_port_is_opened() -> None:
    line = Line(LineSettings(19200), [hcp2(1)], chance=random.Random(1))
    finding = examined(line, (1,)).on("open")
    assert finding == Finding("open", True, "it opens at 19200 8N1", "Host Comms Protocol 2 usually has 57600 8N1")
    line = Line(LineSettings(57600, 8, "E"), [hcp2(1)], chance=random.Random(1))
    assert examined(line, (1,)).on("open").advice == "Host Comms Protocol 2 usually has 57600 8N1"
    assert examined(line_of("hcp2", [hcp2(1)]), (1,)).on("open").advice == ""


@pytest.mark.parametrize(
    ("addresses", "crowd"),
    [
        ((7,), "node 7"),
        ((7, 9), "nodes 7, 9"),
        (tuple(range(8)), "nodes 0, 1, 2, 3, 4, 5, 6, 7"),
        (tuple(range(9)), "any of 9 addresses"),
    ],
)
def test_many_silent_nodes_are_counted_and_few_are_named(addresses: tuple[int, ...], crowd: str) -> None:
    patient = Patient(MemoryPort(line_of("hcp2", [])), "hcp2", addresses=addresses)
    assert patient.crowd(addresses) == crowd


def test_silent_nodes_are_reported_only_if_the_user_has_named_them() -> None:
    for named, topics in ((True, ["node 1", "node 2", "node 3"]), (False, ["node 2"])):
        tap, findings = Requests(), Findings()
        patient = Patient(MemoryPort(line_of("hcp2", [hcp2(2)])), "hcp2", addresses=(1, 2, 3), named=named)
        run_in_virtual_time(examine(patient, findings.append, tap))
        assert [finding.topic for finding in findings if finding.topic.startswith("node ")] == topics
        absent = examination.SILENT_PROBES if named else 1
        assert tap.asked == {1: absent, 2: 1 + examination.PROBES, 3: absent}


class Requests(Tap):
    """Counts the requests to each node."""

    def __init__(self) -> None:
        self.asked: Counter[int] = Counter()
        self.sent = b""

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.sent += data

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        pass

    def attempted(self, attempt: Attempt, /) -> None:
        self.asked[attempt.address] += 1


# Before anybody is asked


def test_without_a_protocol_nothing_is_sent_but_bytes_that_no_node_replies_to() -> None:
    for words, sent, topics in (
        (b"\x11\x22", b"", ["open", "silence"]),
        (b"", HARMLESS, ["open", "silence", "echo", "nodes"]),
    ):
        tap, findings = Requests(), Findings()
        port = MemoryPort(line_of("hcp2", [Chatterbox(words)] if words else []))
        run_in_virtual_time(examine(Patient(port), findings.append, tap))
        assert [finding.topic for finding in findings] == topics
        assert tap.sent == sent


def test_bytes_that_the_opening_of_a_port_causes_are_not_unexpected() -> None:
    class Click(Chatterbox):
        def wake(self, now: float) -> None:
            self.reply(self.words, now, 0.0)
            self.wakeup = inf

    assert examined(line_of("hcp2", [Click(b"\x11"), hcp2(1)]), (1,)).wrong == set()


def test_the_harmless_bytes_begin_no_frame_and_acknowledge_nothing() -> None:
    for protocol, handle in kinds().items():
        profile = handle.profile
        request = profile.probe.open(profile.addresses[0], profile.timings).request
        assert not set(HARMLESS) & {request[0], 0x02, 0x04, 0x06, 0x07, 0x08, 0x15}, protocol


def test_where_another_master_is_heard_nothing_is_sent() -> None:
    request = bytes.fromhex("07 30 35 02 30 31 05 03")  # HCP2: read element 1 of node 5
    findings = examined(line_of("hcp2", [Chatterbox(request), hcp2(1)]), (1,))
    assert findings[-1] is findings.on("silence")
    assert "another master is active, so nothing was sent" in findings[-1].what


def test_noise_is_described_and_the_nodes_are_asked_all_the_same() -> None:
    line = line_of("hcp2", [Chatterbox(bytes(5)), hcp2(1)])
    findings = examined(line, (1,))
    assert findings.on("silence").what.startswith("5 unexpected bytes were received: 00 00 00 00 00 (zeros: ")
    assert "node 1" in {finding.topic for finding in findings}


@pytest.mark.parametrize(("present", "declared"), [(True, False), (False, True), (True, True), (False, False)])
def test_an_echo_is_found_and_what_was_declared_is_checked(present: bool, declared: bool) -> None:
    line = line_of("hcp2", [hcp2(1)], echo=Echo(0.003) if present else None)
    findings = examined(line, (1,), port=Claiming(line, declared))
    assert findings.wrong == (set() if present == declared else {"echo"})
    assert findings.on("node 1").ok
    if present and not declared:
        assert "--echo" in findings.on("echo").advice


@dataclass(frozen=True)
class Holding(MemoryPort):
    """A port that holds received bytes for a third of a second."""

    @property
    def receive_latency(self) -> float:
        return 0.3


def test_an_echo_is_found_behind_a_port_that_holds_bytes() -> None:
    line = line_of("hcp2", [hcp2(1)], echo=Echo(0.25))
    assert examined(line, (1,), port=Holding(line)).on("echo").what.startswith("the adapter receives its own")


def test_bytes_that_are_damaged_by_the_opening_of_a_port_are_not_faults_of_the_line() -> None:
    class Spoilt(MemoryPort):
        async def open(self, protocol_factory: Any, only: Any = None) -> MemoryTransport:
            protocol: Any = protocol_factory()
            transport = await super().open(lambda: protocol, only)
            for mark in (Mark.DAMAGED, Mark.BREAK):
                protocol.byte_marked(b"\0", mark)
            return transport

    line = line_of("hcp2", [hcp2(1)])
    assert examined(line, (1,), port=Spoilt(line)).wrong == set()


def test_an_echo_that_differs_from_what_was_sent_is_shown() -> None:
    line = line_of("hcp2", [], echo=Echo(corrupt=1.0))
    assert "after 00 55 00, these bytes were received: " in examined(line, (1,)).on("echo").what


# Nodes in trouble


@pytest.mark.parametrize("second", [Delay(0.012), Delay(0.04), Delay(0.1)])
def test_two_nodes_with_one_address_that_answer_after_each_other_are_found(second: Delay) -> None:
    """Within the silence after a reply, or so late that the reply comes to the next request."""
    findings = examined(line_of("hcp2", [hcp2(5), hcp2(5, second), hcp2(6)]), (5, 6))
    assert findings.wrong == {"node 5"}
    assert "there is another node with address 5" in findings.on("node 5").what


def test_two_nodes_with_one_address_that_talk_at_once_are_found() -> None:
    twins = [hcp2(5, Delay(0.002, 0.004)), hcp2(5, Delay(0.002, 0.004))]
    findings = examined(line_of("hcp2", [*twins, hcp2(6)]), (5, 6))
    assert findings.wrong == {"node 5"}
    assert "there is another node with address 5" in findings.on("node 5").what


def test_a_node_that_is_garbled_while_the_others_are_clean_may_have_a_twin() -> None:
    findings = examined(line_of("hcp2", [hcp2(5, flip=0.3), hcp2(6)]), (5, 6))
    assert findings.wrong == {"node 5"}
    assert "replies garbled" in findings.on("node 5").what
    assert "another node with address 5" in findings.on("node 5").advice


def test_the_reply_window_of_the_options_is_that_of_the_requests() -> None:
    line, findings = line_of("hcp2", [hcp2(5, Delay(0.2))]), Findings()
    timings = find("hcp2").profile.timings.with_window(0.3)
    patient = Patient(MemoryPort(line), "hcp2", timings, addresses=(5,), named=True)
    run_in_virtual_time(examine(patient, findings.append))
    assert findings.on("node 5").ok
    assert findings.on("windows").what.endswith("set are 50 / 300 / 300 ms (late_after / window / max_reply_delay)")


def test_where_all_nodes_are_garbled_the_line_is_suspected() -> None:
    findings = examined(line_of("hcp2", [hcp2(5), hcp2(6)], faults=Faults(flip=0.4)), (5, 6))
    assert {"node 5", "node 6"} <= findings.wrong
    assert "termination" in findings.on("node 5").advice


def test_a_node_that_sometimes_does_not_answer_is_said_so() -> None:
    findings = examined(line_of("hcp2", [hcp2(5, lost=0.3)]), (5,))
    assert findings.wrong == {"node 5"}
    assert "requests, although it is alive: read element 1: 0" in findings.on("node 5").what


class Stuttering(Device):
    """Begins a reply to each request, and never ends it."""

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.attentive = True
        profile = find("hcp2").profile
        self._request = profile.probe.open(address, profile.timings).request
        self._heard = b""

    def hear_byte(self, byte: int, now: float) -> None:
        self._heard += bytes((byte,))
        if self._heard.endswith(self._request):
            self.reply(b"\x02\x30\x31", now, 0.002)


def test_where_all_replies_are_garbled_other_settings_are_tried_too() -> None:
    findings = examined(line_of("hcp2", [Stuttering(5)]), (5,))
    assert findings.on("node 5").what == "25 of 25 replies garbled (cut short): 02 30 31"
    assert findings.on("settings").what == "node 5: no reply with 20 other settings either"
    assert "nodes" not in {finding.topic for finding in findings}


class Vanishing(MemoryPort):
    """A port that is unplugged while nodes are asked."""

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: identity.Identity | None = None
    ) -> MemoryTransport:
        transport = await MemoryPort.open(self, protocol_factory, only)
        asyncio.get_running_loop().call_later(0.8, transport.lose, OSError(5, "Input/output error"))
        return transport


def test_a_port_that_is_lost_meanwhile_is_the_last_finding() -> None:
    line = line_of("hcp2", [])
    findings = examined(line, range(1, 100), port=Vanishing(line))
    assert [finding.topic for finding in findings] == ["open", "silence", "echo", "port"]
    assert findings[-1] == Finding("port", False, "Input/output error", "start again when it is back")


def test_a_port_that_this_user_may_not_open_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    findings = Findings()
    monkeypatch.setattr(os, "access", lambda *_: False)
    with plugged() as pty_master:
        asyncio.run(examine(Patient(SerialPort(pty_master.path, baudrate=57600)), findings.append))
    assert [finding.topic for finding in findings] == ["port", "permission", "holders"]
    assert findings.wrong == {"permission"}


def test_a_named_node_that_is_not_there_is_named_and_the_others_are_measured() -> None:
    findings = examined(line_of("hcp2", [hcp2(5)]), (5, 9))
    assert findings.wrong == {"node 9"}
    assert findings.on("node 9").what == "does not reply"


@dataclass(frozen=True)
class Damaged(MemoryPort):
    """A port that marks errors at these times."""

    marks: tuple[tuple[float, Mark], ...] = ()

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: identity.Identity | None = None
    ) -> MemoryTransport:
        wire: Any = protocol_factory()
        for at, mark in self.marks:
            asyncio.get_running_loop().call_later(at, wire.byte_marked, b"", mark)
        return await MemoryPort.open(self, lambda: wire, only)


def test_damaged_bytes_are_reported_unless_the_opening_of_the_port_has_caused_them() -> None:
    opening, asking = examination.OPENING / 2, examination.OPENING + examination.LISTENING + 0.01
    line = line_of("hcp2", [hcp2(1)])
    clicks = tuple((opening, mark) for mark in (Mark.DAMAGED, Mark.BREAK))
    assert examined(line, (1,), port=Damaged(line, clicks)).wrong == set()
    marks = tuple((asking, mark) for mark in (Mark.DAMAGED, Mark.DAMAGED, Mark.BREAK))
    findings = examined(line, (1,), port=Damaged(line, marks))
    assert [one.what for one in findings if one.topic == "uart"] == ["2 parity or framing errors", "1 break"]


class Courses:
    """The courses of an examination, each with the number of its steps and how many of these were shown."""

    def __init__(self) -> None:
        self.shown: dict[str, list[int]] = {}

    @contextlib.contextmanager
    def __call__(self, label: str, steps: int) -> Iterator[Courses]:
        self.shown[label] = [steps, 0]
        yield self

    def advance(self) -> None:
        [*_, last] = self.shown.values()
        last[1] += 1


def test_an_examination_shows_how_far_it_is() -> None:
    for nodes, shown in (
        ((2, 3), {"asking": [3, 3], "measuring": [2 * examination.PROBES] * 2}),
        ((), {"asking": [3, 3], "measuring": [0, 0], "trying rates": [20, 20]}),
    ):
        courses = Courses()
        port = MemoryPort(line_of("hcp2", [hcp2(node) for node in nodes]))
        run_in_virtual_time(examine(Patient(port, "hcp2", addresses=(1, 2, 3), progress=courses), lambda _: None))
        assert courses.shown == shown


def test_a_port_that_floods_is_examined_all_the_same(busmaster: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=flood, args=(server,), daemon=True)
        thread.start()
        done = busmaster("doctor", f"socket://127.0.0.1:{server.getsockname()[1]}")
    assert done.status == 1
    assert "unexpected bytes were received" in done.out


def flood(server: socket.socket) -> None:
    """The first client, until it goes away."""
    client, _ = server.accept()
    with client, contextlib.suppress(OSError):
        while True:
            client.sendall(bytes(65536))


def test_where_nobody_answers_that_is_one_finding() -> None:
    findings = examined(line_of("hcp2", [hcp2(5)]), (6, 7))
    assert findings.wrong == {"nodes", "settings"}
    assert findings.on("nodes").what == "no reply from nodes 6, 7 at 57600 8N1"
    assert findings.on("settings").what == "nodes 6, 7: no reply with 20 other settings either"


def test_what_learned_windows_would_come_to_is_said() -> None:
    findings = examined(line_of("hcp2", [hcp2(5, Delay(0.020))]), (5,))
    assert findings.on("learning").what.startswith("learned windows would be 32 ms at most; a lost reply would occupy")
    assert "instead of 150 ms" in findings.on("learning").what
    findings = examined(line_of("hcp2", [hcp2(5, Delay(0.080))]), (5,))
    assert "would not be shorter than the configured one" in findings.on("learning").what


@pytest.mark.parametrize(
    ("milliseconds", "wrong", "advice"),
    [
        (
            4,
            False,
            "timing = { window = 0.015, max_reply_delay = 0.025 } in LINE.toml would waste less time on dead nodes",
        ),
        (
            30,
            False,
            "timing = { window = 0.095, max_reply_delay = 0.145 } in LINE.toml would waste less time on dead nodes",
        ),
        (34, False, ""),
        (70, False, "counted late; late_after = 110 ms would fit"),
        (120, True, "--timeout 365"),
    ],
)
def test_windows_are_suggested_from_what_was_measured(milliseconds: int, wrong: bool, advice: str) -> None:
    findings = examined(line_of("hcp2", [hcp2(5, Delay(milliseconds / 1000))]), (5,))
    assert findings.wrong == ({"windows"} if wrong else set())
    said = findings.on("windows").advice
    assert advice in said if advice else not said


@pytest.mark.parametrize(
    ("data", "guess"),
    [
        ("00 00 80", "zeros"),
        ("ff ff fe", "ones"),
        ("82 30 31 b1 03", ""),
        ("82 30 b1 b2 03", "even parity"),
        ("02 b0 31 32 83", "odd parity"),
        ("11 22", ""),
    ],
)
def test_garbage_is_shown_with_what_it_looks_like(data: str, guess: str) -> None:
    text = diagnosis.garbage(bytes.fromhex(data))
    assert text.startswith(data)
    assert guess in text
    assert bool(guess) == ("(" in text)


# As a command


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """These take their time in earnest."""
    monkeypatch.setattr(examination, "LISTENING", 0.05)
    monkeypatch.setattr(examination, "ECHOING", 0.03)
    monkeypatch.setattr(examination, "PROBES", 4)


@pytest.mark.slow
@pytest.mark.usefixtures("hasty")
def test_a_pty_is_examined_and_the_status_is_0_if_all_is_well(busmaster: Command) -> None:
    with serve_pty(line_of("hcp2", [hcp2(1)], paced=False)) as server:
        done = busmaster("doctor", server.path, *HCP2, "--nodes", "1", "--timeout", "1000")
    assert (done.status, done.err) == (0, "")
    assert [line.split()[1] for line in done.lines if line[:4].strip()] == [
        *("port", "permission", "holders", "open", "driver", "rs485", "silence", "echo", "node", "windows", "learning")
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("hasty")
@pytest.mark.filterwarnings("default:.*RTS is switched by software")
@pytest.mark.parametrize(
    ("by", "what"), [("driver", "the line was free "), ("software", "software releases the line ")]
)
def test_the_turnaround_of_a_port_with_rs485_is_measured(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, by: str, what: str
) -> None:
    FakeDriver(monkeypatch)
    with serve_pty(line_of("hcp2", [hcp2(1, Delay(0.02))], paced=False)) as server:
        port = f"{server.path}?baudrate=57600&rs485.by={by}"
        done = busmaster("doctor", port, *HCP2, "--nodes", "1", "--timeout", "1000")
    [line] = [line for line in done.lines if line.split()[1:2] == ["turnaround"]]
    assert not line.startswith("FAIL")
    assert what in line
    assert ("RTS is switched by software" in done.err) is (by == "software")
    assert ("software switches the transmitter by RTS" in "\n".join(done.lines)) is (by == "software")


def test_a_release_after_the_beginning_of_a_reply_is_to_be_changed() -> None:
    late, soon = [0.0002, 0.0031], [0.0002, 0.0009]
    [finding] = diagnosis.turnaround([0.004, 0.005], late, byte_time=0.001)
    assert not finding.ok
    assert "releases the line 0.2 / 1.6 / 3.1 ms after" in finding.what
    assert "a reply began after 3 ms" in finding.what
    [finding] = diagnosis.turnaround([0.004, 0.005], soon, byte_time=0.001)
    assert finding.ok
    assert [*diagnosis.turnaround([], None, byte_time=0.001)] == []
    [finding] = diagnosis.turnaround([], soon, byte_time=0.001)
    assert finding.ok
    [finding] = diagnosis.turnaround([0.004, 0.005], None, byte_time=0.001)
    assert finding.ok
    assert "free 3 ms after the last bit at the latest" in finding.what


@pytest.mark.slow
@pytest.mark.usefixtures("hasty")
def test_json_has_an_object_for_each_finding(busmaster: Command) -> None:
    with serve_pty(line_of("hcp2", [hcp2(1)], paced=False)) as server:
        done = busmaster("doctor", server.path, *HCP2, "--nodes", "1", "--timeout", "1000", "--json")
    findings = list(map(without_time, done.lines))
    assert {tuple(finding) for finding in findings} == {("topic", "ok", "what", "advice")}
    assert findings[0] == {"topic": "port", "ok": True, "what": f"{server.path} exists", "advice": ""}


@pytest.mark.usefixtures("hasty")
def test_an_adapter_is_examined_by_its_serial_number_and_by_its_path_that_name_is_recommended(
    busmaster: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identity, "SYS", tmp_path / "sys")
    usb = UsbTree(tmp_path / "sys")
    with serve_pty(line_of("hcp2", [hcp2(1)], paced=False)) as server:
        usb.plug(server.path, "A500ABC")
        by_serial = busmaster("doctor", "usb:A500ABC")  # and no node, which a busy machine may make late
        by_path = busmaster("doctor", server.path)
        value = busmaster("read", "usb:A500ABC", *HCP2, "--node", "1", "--timeout", "5000", "1")
    absent = busmaster("doctor", "usb:A500XYZ")
    assert (by_serial.status, by_path.status) == (0, 0), by_serial.out + by_path.out
    assert f"ok    name        {server.path} is FTDI A500ABC, which usb:A500ABC finds again\n" in by_serial.out
    assert "-> name it usb:A500ABC, " in by_path.out
    assert (value.status, value.out) == (0, "1 0\n")
    assert absent.status == 1
    assert f"usb:A500XYZ is not plugged in: connected: usb:A500ABC ({server.path})" in absent.out


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("obeys", [True, False])
def test_where_low_latency_is_asked_for_the_latency_timer_is_judged_as_the_opening_leaves_it(
    busmaster: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, obeys: bool
) -> None:
    monkeypatch.setattr(identity, "SYS", tmp_path / "sys")
    usb = UsbTree(tmp_path / "sys")
    timer = tmp_path / "sys/devices/1-1/1-1:1.0/ttyUSB0/latency_timer"

    def set_flag(port: serial.Serial, flag: bool) -> None:
        assert timer.read_text() == "16\n"
        if flag and obeys:
            timer.write_text("1\n")

    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", set_flag)
    monkeypatch.setattr(adapters, "low_latency", lambda _: timer.read_text() == "1\n")
    with serve_pty(line_of("hcp2", [hcp2(1)], paced=False)) as server:
        usb.plug(server.path, "A500ABC")
        device = tmp_path / "sys/class/tty" / os.path.basename(server.path)
        device.mkdir()  # by the last part of its path, as of a node in /dev
        (device / "device").symlink_to(timer.parent)
        timer.write_text("16\n")
        plain = busmaster("doctor", "usb:A500ABC")
        asked = busmaster("doctor", "usb:A500ABC?low_latency=1")
    [before] = [line for line in plain.lines if " latency " in line]
    assert "16 ms" in before
    assert "add ?low_latency=1" in plain.out
    assert "?low_latency=1 may" in plain.out
    assert "?low_latency=1" not in asked.out
    assert f"its low-latency flag is {'set' if obeys else 'not set, although low_latency=1 was given'}\n" in asked.out
    [after] = [line for line in asked.lines if " latency " in line]
    assert ("1 ms" if obeys else "16 ms") in after
    assert after.startswith("ok" if obeys else "FAIL")
    assert ("low_latency=1 did not shorten it; write 1 to" in asked.out) is not obeys
    assert asked.out.count("gathers received bytes") == 1


@pytest.mark.usefixtures("hasty")
def test_a_tcp_port_is_examined_as_far_as_it_can_be(busmaster: Command, controllers: TcpServer, tmp_path: Path) -> None:
    file = tmp_path / "line.pcapng"
    done = busmaster("doctor", controllers.path, *HCP2, "--nodes", "8,77", "--capture", str(file))
    assert done.status == 1
    assert "the adapter checks do not apply to a TCP port" in done.out
    assert "-> check the server's own: line settings, and bytes passed on at once" in done.out
    assert "FAIL  node 77     does not reply\n" in done.out
    assert done.err == f"busmaster: {controllers.path.removeprefix('socket://')}: 1 thing to fix\n"
    with file.open("rb") as capture:
        packets = list(read_packets(capture))
    assert bytes.fromhex("07 30 38 02 30 31 05 0E") in [packet.frame for packet in packets]
    told = {(packet.node, packet.outcome.name, packet.comment) for packet in packets}
    assert (8, "NONE", "probe") in told
    assert (8, "OK", "read element 1: 0.0") in told
    assert (77, "NO_REPLY", "read element 1: no reply") in told


@pytest.mark.usefixtures("hasty")
def test_without_a_protocol_no_node_is_asked(busmaster: Command, controllers: TcpServer) -> None:
    done = busmaster("doctor", controllers.path)
    assert done.status == 0
    assert "no request was sent" in done.out


@pytest.mark.parametrize("port", ["/dev/absent", "/dev/null", "socket://127.0.0.1:1"])
def test_a_port_that_does_not_open_is_a_finding(busmaster: Command, port: str) -> None:
    done = busmaster("doctor", port)
    assert done.status == 1
    assert done.lines[-2].startswith("FAIL")
    assert done.lines[-1].strip().startswith("-> ")


def test_while_another_program_has_the_port_it_is_not_even_opened(busmaster: Command) -> None:
    with plugged() as pty_master:
        hold = f"f = open({pty_master.path!r}); print(flush=True); input()"
        with subprocess.Popen([sys.executable, "-ISc", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
            assert other.stdout is not None
            other.stdout.readline()
            done = busmaster("doctor", pty_master.path, *HCP2)
            assert pty_master.read(0) == b""
            other.communicate(b"\n")
    assert done.status == 1
    assert f"(process {other.pid})" in done.out
    assert "open " not in [line[6:16] for line in done.lines]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("PORT", "--nodes", "1"), "--nodes needs the protocol"),
        (("PORT", "--protocol", "mentor", "--nodes", "0-3"), "is the broadcast address"),
        (("PORT", "--protocol", "dc104", "--nodes", "1"), "has no node addresses"),
        (("PORT?baud=3",), "did you mean 'baudrate'?"),
        (("PORT", "--protocol", "hcp4"), "no such protocol 'hcp4'; did you mean 'hcp'?"),
    ],
)
def test_wrong_usage_is_status_2_and_nothing_is_examined(
    busmaster: Command, arguments: tuple[str, ...], complaint: str
) -> None:
    done = busmaster("doctor", *arguments)
    assert (done.status, done.out) == (2, "")
    assert complaint in done.err


# Other settings


def rate_of(path: str) -> int:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        return int(termios.tcgetattr(port)[5])
    finally:
        os.close(port)


@pytest.mark.usefixtures("hasty")
def test_a_wrong_rate_is_found_and_the_port_is_left_as_it_was(busmaster: Command) -> None:
    with serve_pty(Line(LineSettings(9600), [hcp2(1)], paced=False)) as server:
        done = doctor_of_a_paced(server, busmaster)
        assert rate_of(server.path) == termios.B57600
    assert done.status == 1
    assert "no reply from node 1 at 57600 8N1" in done.out
    assert "node 1 replies at 9600 8N1\n" in done.out
    assert "add ?baudrate=9600&bytesize=8&parity=N to the port" in done.out


@pytest.mark.usefixtures("hasty")
def test_no_other_rate_is_tried_on_a_pseudo_terminal(busmaster: Command) -> None:
    with serve_pty(line_of("hcp2", [], paced=False)) as server:
        done = busmaster("doctor", server.path, *HCP2, "--nodes", "1", "--timeout", "50")
    assert "no reply from node 1" in done.out
    assert "a pseudo-terminal has no baud rate: no other was tried\n" in done.out
    assert "other settings either" not in done.out


@pytest.mark.usefixtures("hasty")
def test_where_no_rate_helps_it_is_said_what_was_tried(busmaster: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examination, "RATES", (9600, 19200))
    monkeypatch.setattr(examination, "FRAMINGS", ())
    with serve_pty(line_of("hcp2", [], paced=False)) as server:
        done = doctor_of_a_paced(server, busmaster)
    assert "no reply with 2 other settings either" in done.out


def doctor_of_a_paced(server: PtyServer, busmaster: Callable[..., Ended]) -> Ended:
    """Where it is told that the port is paced, a rate matters."""
    return busmaster("doctor", f"{server.path}?paced=1", *HCP2, "--nodes", "1")


def test_other_rates_are_tried_before_other_framings_and_none_twice() -> None:
    candidates = other_settings(LineSettings(9600, 7, "E"))
    assert len(set(candidates)) == len(candidates)
    assert LineSettings(9600, 7, "E") not in candidates
    framings = [candidate.framing for candidate in candidates]
    assert framings == sorted(framings, key=["7E1", "8N1", "8E1"].index)
    assert {candidate.stopbits for candidate in other_settings(LineSettings(9600, stopbits=2))} == {2}


@pytest.mark.usefixtures("hasty")
@pytest.mark.asyncio
async def test_other_rates_are_tried_at_a_server_with_rfc_2217_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examination, "RATES", (9600,))
    monkeypatch.setattr(examination, "FRAMINGS", ())
    rates: list[object] = []

    def takes(name: str, value: object) -> bool:
        if name == "baudrate":
            rates.append(value)
        return True

    remote = RemotePort(takes)
    async with rfc2217_server(port=remote) as server:
        findings = Findings()
        port = Rfc2217Port("127.0.0.1", server.number, baudrate=57600)
        await examine(Patient(port, "hcp2", addresses=(4,)), findings.append)
    assert [finding.topic for finding in findings] == [
        *("adapter", "open", "line errors", "modem lines", "silence", "echo", "nodes", "settings")
    ]
    assert findings.on("settings").what == "node 4: no reply with 1 other settings either"
    assert (rates[-2:], remote.baudrate) == ([9600, 57600], 57600)


@dataclass(frozen=True)
class Tunable(MemoryPort):
    """A port whose own settings differ from those of the line."""

    own: LineSettings = HCP2_SETTINGS

    @property
    def settings(self) -> LineSettings:
        return self.own

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: identity.Identity | None = None
    ) -> MemoryTransport:
        transport = await MemoryPort.open(self, protocol_factory, only)
        await transport.tune(self.own)
        return transport


@pytest.mark.parametrize("settings", [LineSettings(9600), LineSettings(2400), LineSettings(19200, 7, "E")])
def test_a_node_at_other_settings_is_found_at_any_of_the_first_addresses(settings: LineSettings) -> None:
    line = Line(settings, [hcp2(4), hcp2(5)], chance=random.Random(1))
    findings = examined(line, (1, 2, 4, 5), port=Tunable(line))
    assert findings.on("nodes").what == "no reply from nodes 1, 2, 4, 5 at 57600 8N1"
    assert findings.on("settings").what == f"nodes 1, 2, 4, 5: node 4 replies at {diagnosis.speed(settings)}"
    assert line.host == LineSettings(57600), "the settings of the port are as they were"


def test_the_wait_for_a_reply_begins_with_the_end_of_its_request_at_each_of_the_other_rates() -> None:
    line = Line(LineSettings(2400), [hcp2(4, Delay(0.08))], chance=random.Random(1))  # it takes 33 ms there
    assert examined(line, (4,), port=Tunable(line)).on("settings").what == "node 4: node 4 replies at 2400 8N1"


@dataclass(frozen=True)
class Slow(Tunable):
    """A port that takes half a second to change its settings."""

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: identity.Identity | None = None
    ) -> MemoryTransport:
        transport = await Tunable.open(self, protocol_factory, only)
        tune = transport.tune

        async def slowly(settings: LineSettings) -> None:
            await asyncio.sleep(0.5)
            await tune(settings)

        transport.tune = slowly  # type: ignore[method-assign]  # of this one
        return transport


def test_a_doctor_that_is_interrupted_leaves_the_port_as_it_was() -> None:
    line = Line(LineSettings(9600), [], chance=random.Random(1))
    hosts: list[LineSettings | None] = []

    async def interrupt() -> None:
        asyncio.get_running_loop().call_later(3.9, lambda: hosts.append(line.host))
        with anyio.move_on_after(4.0) as interrupted:
            await examine(Patient(Slow(line), "hcp2", addresses=(4,), named=True), lambda _: None)
        assert interrupted.cancelled_caught

    run_in_virtual_time(interrupt())
    assert hosts != [HCP2_SETTINGS], "it was trying others"
    assert line.host == HCP2_SETTINGS


@dataclass(frozen=True)
class Choosy(Tunable):
    """A port that does not take 9600 baud, the first of the other rates."""

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: identity.Identity | None = None
    ) -> MemoryTransport:
        return without_rate(await Tunable.open(self, protocol_factory, only), 9600)


def test_after_settings_that_the_port_does_not_take_the_next_are_tried() -> None:
    line = Line(LineSettings(19200), [hcp2(4)], chance=random.Random(1))
    findings = examined(line, (4,), port=Choosy(line))
    assert findings.on("settings").what == "node 4: node 4 replies at 19200 8N1"


def test_no_more_than_some_nodes_are_tried_at_each_of_the_other_settings() -> None:
    line = Line(LineSettings(9600), [hcp2(5)], chance=random.Random(1))
    findings = examined(line, (1, 2, 3, 4, 5), port=Tunable(line))
    tried = len(other_settings(LineSettings(57600)))
    assert findings.on("settings").what == f"nodes 1, 2, 3, 4: no reply with {tried} other settings either"


@pytest.mark.parametrize(("nodes", "named"), [(None, False), ((), True), ((3, 4), True)])
def test_nodes_are_named_only_if_the_user_has_named_them(nodes: tuple[int, ...] | None, named: bool) -> None:
    assert patient_of(Connection("/dev/ttyUSB0", "hcp2"), nodes).named is named


# What the options are for


def connection(*options: Any) -> Connection:
    return Connection("/dev/ttyS0", *options)


def test_rate_echo_and_window_of_the_options_are_those_of_the_examination() -> None:
    plain = patient_of(connection("mentor"), (1,))
    assert plain.endpoint == SerialPort("/dev/ttyS0", baudrate=9600, bytesize=7, parity="E")
    assert (plain.timings, plain.addresses) == (None, (1,))
    given = patient_of(connection("mentor", 4800, True, 0.25), None)
    assert given.endpoint == SerialPort("/dev/ttyS0", baudrate=4800, bytesize=7, parity="E", echo=True)
    assert given.timings == find("mentor").profile.timings.with_window(0.25)
    assert given.addresses == tuple(find("mentor").profile.addresses)
    assert plain.progress is given.progress is Bar


def test_without_a_protocol_the_port_has_the_usual_settings_or_those_of_the_options() -> None:
    plain, given = patient_of(connection(""), None), patient_of(connection("", 4800, True), None)
    assert plain.endpoint == SerialPort("/dev/ttyS0", baudrate=9600)
    assert given.endpoint == SerialPort("/dev/ttyS0", baudrate=4800, echo=True)
    assert plain.progress is given.progress is Bar
    of_port = patient_of(replace(connection(""), port="/dev/ttyS0?echo=1"), None)
    assert of_port.endpoint == SerialPort("/dev/ttyS0", baudrate=9600, echo=True)


@pytest.fixture
def patients(monkeypatch: pytest.MonkeyPatch) -> list[Patient]:
    """The examinations that were begun. Each has three findings, two of which are not in order."""
    begun: list[Patient] = []

    def until_ended(_: object, patient: Patient, report: Callable[[Finding], None], recorder: object) -> None:
        begun.append(patient)
        for finding in (
            Finding("open", True, "opened", "use another cable"),
            Finding("echo", False, "an echo", "add --echo"),
            Finding("silence", True, "silent"),
            Finding("node 1", False, "no reply", "check the wires"),
        ):
            report(finding)

    monkeypatch.setattr(doctor, "until_ended", until_ended)
    return begun


def test_every_option_of_the_doctor_reaches_its_examination(
    busmaster: Command, patients: list[Patient], monkeypatch: pytest.MonkeyPatch
) -> None:
    captured: list[dict[str, object]] = []

    def noted(path: str | None, **fields: object) -> contextlib.AbstractContextManager[None]:
        captured.append({"path": path, **fields})
        return contextlib.nullcontext()

    monkeypatch.setattr(doctor, "capturing", noted)
    options = ("--protocol", "mentor", "--nodes", "2,3", "--baud", "4800", "--echo", "--timeout", "250")
    busmaster("doctor", "/dev/ttyS0", *options, "--capture", "line.pcapng")
    busmaster("doctor", "/dev/ttyS0", "--baud", "4800", "--echo")
    of_nodes, of_port = patients
    assert of_nodes.endpoint == SerialPort("/dev/ttyS0", baudrate=4800, bytesize=7, parity="E", echo=True)
    assert (of_nodes.addresses, of_nodes.named) == ((2, 3), True)
    assert of_nodes.timings == find("mentor").profile.timings.with_window(0.25)
    assert of_port.endpoint == SerialPort("/dev/ttyS0", baudrate=4800, echo=True)
    assert captured == [
        {"path": "line.pcapng", "port": "/dev/ttyS0", "protocol": "mentor", "echo": True},
        {"path": None, "port": "/dev/ttyS0", "protocol": "", "echo": True},
    ]


@pytest.mark.usefixtures("patients")
def test_each_finding_has_its_mark_and_advice_and_those_to_fix_are_counted(busmaster: Command) -> None:
    done = busmaster("doctor", "/dev/ttyS0")
    assert (done.status, done.err) == (1, "busmaster: /dev/ttyS0: 2 things to fix\n")
    assert done.lines == [
        "note  open        opened",
        "                  -> use another cable",
        "FAIL  echo        an echo",
        "                  -> add --echo",
        "ok    silence     silent",
        "FAIL  node 1      no reply",
        "                  -> check the wires",
    ]


@pytest.mark.usefixtures("patients")
def test_findings_in_json_have_all_their_fields_and_the_time_of_day(busmaster: Command) -> None:
    done = busmaster("doctor", "/dev/ttyS0", "--json")
    assert done.status == 1
    assert [without_time(line) for line in done.lines][1:3] == [
        {"topic": "echo", "ok": False, "what": "an echo", "advice": "add --echo"},
        {"topic": "silence", "ok": True, "what": "silent", "advice": ""},
    ]
