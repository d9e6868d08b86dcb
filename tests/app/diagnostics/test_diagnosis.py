"""What the doctor concludes from bytes and probes: each finding with its advice."""

from __future__ import annotations

import pytest

from busmaster import LineSettings, ReplyTiming
from busmaster.app.diagnostics import diagnosis
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.diagnosis import Record
from busmaster.app.diagnostics.probing import Outcome, Probe
from busmaster.protocols.hcp2 import codec as hcp2

TIMING = ReplyTiming(0.05, 0.1, 0.15, 0.02)
SILENT = Probe(Outcome.SILENT)
GARBLED = Probe(Outcome.GARBLED, 0.001, "a wrong checksum", b"\x01\x02")


def good(start: float | None = 0.002, again: bytes = b"") -> Probe:
    return Probe(Outcome.ANSWERED, start, "read element 1: 0", b"\x02", again)


def record(*probes: Probe, address: int = 1, label: str = "") -> Record:
    return Record(address, label or f"node {address}", list(probes))


# the line


def test_a_record_counts_each_outcome_and_a_reply_before_the_end_of_its_request_came_at_once() -> None:
    found = record(good(0.003), SILENT, GARBLED, good(-0.001, b"\x05"), good(None), SILENT)
    assert [found.count(outcome) for outcome in Outcome] == [3, 2, 1]
    assert (found.lives, found.starts, found.doubled) == (True, [0.0, 0.003], 1)
    assert (record(SILENT, GARBLED).lives, record(SILENT).lives) == (True, False)
    assert (record(GARBLED).answers, record(GARBLED).starts) == ([], [])


def test_bytes_before_any_request_are_those_of_a_master_or_noise() -> None:
    assert diagnosis.unexpected(b"", "hcp2") == Finding("silence", True, "no unexpected bytes were received")
    request = hcp2.Read(1).open(1, hcp2.PROFILE.timings).request
    master = diagnosis.unexpected(request, "hcp2")
    assert not master.ok
    assert master.what.startswith("another master is active, so nothing was sent: ")
    assert master.what.endswith(": read 1")
    assert master.advice.startswith("stop the other master (`busmaster monitor` shows its requests)")
    for heard, protocol in ((request, None), (b"\x11\x22\x33", "hcp2")):
        noise = diagnosis.unexpected(heard, protocol)
        assert (noise.topic, noise.ok) == ("silence", False)
        assert noise.what == f"{len(heard)} unexpected bytes were received: {diagnosis.garbage(heard)}"
        assert noise.advice.startswith("look for a second master, a babbling node, missing biasing")


def test_a_request_of_a_master_that_came_damaged_is_noise() -> None:
    request = bytes.fromhex("01 03 00 00 00 01 84 0a")
    assert diagnosis.unexpected(request, "modbus").what.startswith("another master is active, so nothing was sent: ")
    for damaged, protocol in ((request[:-1] + b"\x0b", "modbus"), (bytes.fromhex("07 30 35 02 30 31 05 04"), "hcp2")):
        assert diagnosis.unexpected(damaged, protocol).what.startswith("8 unexpected bytes were received: ")


@pytest.mark.parametrize(
    ("heard", "declared", "ok", "what", "advice"),
    [
        (b"\x00\x55\x00", False, False, "the adapter receives its own transmissions", "add --echo, or ?echo=1"),
        (b"\x00\x55\x00", True, True, "the adapter receives its own transmissions, as declared", ""),
        (b"\x00\x55\x00\x01", True, True, "the adapter receives its own transmissions, as declared", ""),
        (b"\x00\x45", True, False, "after 00 55 00, these bytes were received: 00 45", "if that is the echo, it is"),
        (b"\x00\x45", False, False, "after 00 55 00, these bytes were received: 00 45", "if that is the echo, it is"),
        (b"", True, False, "the adapter does not receive its own transmissions", "leave the echo option out"),
        (b"", False, True, "the adapter does not receive its own transmissions", ""),
    ],
)
def test_an_echo_is_compared_with_what_was_declared(
    heard: bytes, declared: bool, ok: bool, what: str, advice: str
) -> None:
    finding = diagnosis.echo(b"\x00\x55\x00", heard, declared)
    assert (finding.topic, finding.ok, finding.what) == ("echo", ok, what)
    assert finding.advice.startswith(advice)
    assert bool(advice) == bool(finding.advice)


def test_much_garbage_is_cut_and_half_of_the_bytes_do_not_make_a_pattern() -> None:
    assert diagnosis.garbage(bytes(range(1, 13))) == "01 02 03 04 05 06 07 08 09 0a 0b 0c"
    assert diagnosis.garbage(bytes(range(1, 14))) == "01 02 03 04 05 06 07 08 09 0a 0b 0c ..."
    assert diagnosis.garbage(b"\x00\x11") == "00 11"
    assert diagnosis.garbage(b"\xf8\x12") == "f8 12"
    assert diagnosis.garbage(b"\xf8\x12\xff").startswith("f8 12 ff (ones: a floating line")
    assert diagnosis.garbage(b"\x00\x11\x00").startswith("00 11 00 (zeros: wires A and B swapped")


# the nodes


@pytest.mark.parametrize(
    ("found", "others_are_clean", "what", "advice"),
    [
        (
            record(good(again=b"\x01"), good(), GARBLED),
            True,
            "more than one reply to 1 of 3 requests: there is another node with address 1",
            "switch one off and find the other",
        ),
        (
            record(good(again=b"\x01"), label="the drive"),
            True,
            "more than one reply to 1 of 1 requests: there is another node with no address on this line",
            "switch one off and find the other",
        ),
        (
            record(good(), GARBLED, SILENT),
            True,
            "1 of 3 replies garbled (a wrong checksum): 01 02",
            "look for another node with address 1: does this one still reply when you switch it off? Else check its w",
        ),
        (
            record(good(), GARBLED),
            False,
            "1 of 2 replies garbled (a wrong checksum): 01 02",
            "check baud rate, termination, biasing and the common ground; then check for a shared address",
        ),
        (
            record(Probe(Outcome.GARBLED, 0.001, "too long", b"\x07", hint="set the right mode")),
            True,
            "1 of 1 replies garbled (too long): 07",
            "set the right mode",
        ),
        (record(SILENT, SILENT), True, "does not reply", "check its address, power, wiring and protocol"),
        (
            record(good(), SILENT, SILENT),
            True,
            "no reply to 2 of 3 requests, although it is alive: read element 1: 0",
            "look for a loose contact or terminal",
        ),
    ],
)
def test_what_is_wrong_with_a_node_comes_with_advice(
    found: Record, others_are_clean: bool, what: str, advice: str
) -> None:
    finding = diagnosis.node(found, others_are_clean)
    assert (finding.topic, finding.ok, finding.what) == (found.label, False, what)
    assert finding.advice.startswith(advice)


def test_a_node_in_order_is_measured() -> None:
    finding = diagnosis.node(record(*map(good, (0.004, 0.001, 0.0125, 0.002))), True)
    assert finding == Finding(
        "node 1", True, "replies after 1 / 3 / 12 ms (least / median / p99 of 4): read element 1: 0"
    )


def test_a_garbled_node_may_have_a_twin_only_if_all_other_living_nodes_are_clean() -> None:
    bad, fine, dead = record(GARBLED, address=1), record(good(), address=2), record(SILENT, address=3)
    twin, line = "look for another node", "check baud rate"

    def advice(*records: Record) -> str:
        return next(iter(diagnosis.nodes(records, TIMING))).advice

    assert advice(bad, fine, dead).startswith(twin)
    assert advice(bad, fine, record(good(), GARBLED, address=4)).startswith(line)
    assert advice(bad, record(good(), GARBLED, address=4), fine).startswith(line)
    assert advice(bad, dead).startswith(line)
    assert advice(bad).startswith(line)


def test_reply_times_are_judged_of_all_nodes_together_if_any_replies() -> None:
    found = list(diagnosis.nodes([record(good(0.002)), record(good(0.12), address=2)], TIMING))
    assert [finding.topic for finding in found] == ["node 1", "node 2", "windows", "learning"]
    assert found[2].what.startswith("replies begin within 120 ms; set are 50 / 100 / 150 ms")
    assert [finding.topic for finding in diagnosis.nodes([record(SILENT)], TIMING)] == ["node 1"]


@pytest.mark.parametrize(
    ("slowest", "ok", "advice"),
    [
        (0.101, False, "their values arrive late; use 155 / 305 / 460 ms, or --timeout 305"),
        (0.100, True, "they are counted late; late_after = 150 ms would fit"),
        (0.051, True, "they are counted late; late_after = 80 ms would fit"),
        (0.050, True, ""),
        (0.002, True, "timing = { window = 0.01, max_reply_delay = 0.015 } in LINE.toml would waste less time"),
    ],
)
def test_reply_times_are_suggested_from_the_slowest_reply(slowest: float, ok: bool, advice: str) -> None:
    finding = diagnosis.windows([slowest, 0.001], TIMING)
    assert (finding.topic, finding.ok) == ("windows", ok)
    assert finding.advice.startswith(advice)
    assert bool(finding.advice) == bool(advice)


def test_a_longer_maximum_reply_delay_is_kept_where_values_arrive_late() -> None:
    finding = diagnosis.windows([0.101], ReplyTiming(0.05, 0.1, 2.0, 0.02))
    assert finding.advice == "their values arrive late; use 155 / 305 / 2000 ms, or --timeout 305"


def test_no_window_below_ten_milliseconds_is_suggested() -> None:
    for slowest in (0.0, 0.001, 0.003):
        finding = diagnosis.windows([slowest], TIMING)
        assert finding.advice.startswith("timing = { window = 0.01, max_reply_delay = 0.015 } in LINE.toml")


def test_no_learned_window_is_promised_that_is_not_shorter() -> None:
    assert diagnosis.learning([0.001, 0.02], TIMING).what == (
        "learned windows would be 32 ms at most; a lost reply would occupy the line for about as long, instead of 150 "
        'ms (--timeout learned, timing = "learned")'
    )
    same = "learned windows would not be shorter than the configured one"
    assert diagnosis.learning([0.001, 0.09], TIMING) == Finding("learning", True, same)


def test_if_no_node_replies_the_finding_names_who_was_tried_and_where() -> None:
    finding = diagnosis.nobody("nodes 1, 2", hcp2.PROFILE, LineSettings(9600, 7, "E"))
    assert (finding.topic, finding.ok, finding.what) == ("nodes", False, "no reply from nodes 1, 2 at 9600 7E1")
    assert finding.advice.endswith("the addresses, and that they use Host Comms Protocol 2")
    assert diagnosis.nobody("node 1", hcp2.PROFILE, None).what == "no reply from node 1"


def test_the_settings_at_which_a_node_replied_are_named_also_if_its_address_is_0() -> None:
    settings = LineSettings(9600, 7, "E")
    finding = diagnosis.other_rate(0, settings, "nodes 0, 1", 12)
    assert finding.what == "nodes 0, 1: node 0 replies at 9600 7E1"
    assert finding.advice == "add ?baudrate=9600&bytesize=7&parity=E to the port"
    finding = diagnosis.other_rate(None, settings, "nodes 0, 1", 12)
    assert (finding.topic, finding.ok) == ("settings", False)
    assert finding.what == "nodes 0, 1: no reply with 12 other settings either"
    assert finding.advice == "name your nodes with --nodes if these are not among them"


def test_the_release_of_the_line_is_compared_with_the_earliest_reply() -> None:
    [finding] = diagnosis.turnaround([0.005, 0.004], [0.0031, -0.001, 0.0002], byte_time=0.001)
    assert not finding.ok  # a reply began after 3 ms
    assert "releases the line 0 / 0.2 / 3.1 ms after the calculated end of the last bit (least / median" in finding.what
    assert finding.what.endswith("p99 of 3), but a reply began after 3 ms: the transmitter can damage it")
    [finding] = diagnosis.turnaround([0.005, 0.0042], [0.0031], byte_time=0.001)
    assert finding.ok
    assert list(diagnosis.turnaround([0.005], [], byte_time=0.001)) == []
    [finding] = diagnosis.turnaround([0.0005], None, byte_time=0.001)
    assert "the line was free 0 ms after the last bit" in finding.what
    assert finding.advice == "the driver does not report when it releases the line"


def test_times_are_written_as_a_person_would() -> None:
    assert [diagnosis.milliseconds(s) for s in (0, 0.0004, 0.00996, 0.0099, 0.01, 0.0124, 1.5)] == [
        *("0", "0.4", "10", "9.9", "10", "12", "1500")
    ]
    assert [diagnosis.rounded_up(s) for s in (0.0, 0.001, 0.005, 0.0051)] == pytest.approx([0, 0.005, 0.005, 0.01])
    assert [diagnosis.percentile(list(range(1, n + 1))) for n in (1, 99, 100, 101)] == [1, 99, 99, 100]
    assert diagnosis.percentile([1, 2, 3, 4], 0.5) == 2
