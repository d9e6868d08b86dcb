"""Conclusions from received bytes and replies: findings in words, each with advice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

from busmaster import LineSettings, ReplyTiming
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.probing import Outcome, Probe
from busmaster.capture import Decoder, Kind
from busmaster.ext import Profile, find, window_of

SHOWN = 12
"""Bytes of garbage that are printed."""
STEP = 0.005
"""Suggested times are multiples of this many seconds."""
SHORTEST_WINDOW = 0.01
EVERY_OTHER = 0.5


@dataclass(slots=True)
class Record:
    """All probes of one node."""

    address: int
    label: str
    probes: list[Probe]

    def count(self, outcome: Outcome) -> int:
        """Return how many probes ended so."""
        return sum(probe.outcome is outcome for probe in self.probes)

    @property
    def lives(self) -> bool:
        """Something came, be it garbled."""
        return any(probe.outcome is not Outcome.SILENT for probe in self.probes)

    @property
    def answers(self) -> list[Probe]:
        return [probe for probe in self.probes if probe.outcome is Outcome.ANSWERED]

    @property
    def starts(self) -> list[float]:
        """Seconds until its replies began, in order."""
        return sorted(max(0.0, probe.start) for probe in self.answers if probe.start is not None)

    @property
    def doubled(self) -> int:
        """Requests to which more came than one reply."""
        return sum(bool(probe.again) for probe in self.answers)


# The line


def unexpected(heard: bytes, protocol: str | None) -> Finding:
    """Return the finding about bytes that were received before any request."""
    if not heard:
        return Finding("silence", True, "no unexpected bytes were received")
    known = [] if protocol is None else known_frames(heard, protocol)
    if known:
        return Finding(
            "silence",
            False,
            f"another master is active, so nothing was sent: {known[0]}",
            "stop the other master (`busmaster monitor` shows its requests): two masters garble each other's frames",
        )
    return Finding(
        "silence",
        False,
        f"{len(heard)} unexpected bytes were received: {garbage(heard)}",
        "look for a second master, a babbling node, missing biasing or termination, or a wrong baud rate",
    )


def known_frames(heard: bytes, protocol: str) -> list[str]:
    """Return the whole frames in these bytes, in words."""
    decoder = Decoder(find(protocol).protocol.dialect())
    frames = [*decoder.feed(heard, 0.0), *decoder.quiet()]
    return [frame.text for frame in frames if not frame.fault and frame.kind is not Kind.NOISE]


def echo(sent: bytes, heard: bytes, declared: bool) -> Finding:
    """Return the finding about the bytes received after a test transmission to which no node replies."""
    if heard.startswith(sent):
        if declared:
            return Finding("echo", True, "the adapter receives its own transmissions, as declared")
        return Finding(
            "echo",
            False,
            "the adapter receives its own transmissions",
            "add --echo, or ?echo=1 to the port (echo=True in Python); else every reply would begin with the request",
        )
    if heard:
        return Finding(
            "echo",
            False,
            f"after {sent.hex(' ')}, these bytes were received: {garbage(heard)}",
            "if that is the echo, it is disturbed; look for a second sender, swapped wires or missing biasing",
        )
    if declared:
        return Finding("echo", False, "the adapter does not receive its own transmissions", "leave the echo option out")
    return Finding("echo", True, "the adapter does not receive its own transmissions")


def garbage(data: bytes) -> str:
    """Return a few of the bytes, with a likely cause of their pattern."""
    text = data[:SHOWN].hex(" ") + (" ..." if len(data) > SHOWN else "")
    guess = _looks_like(data)
    return f"{text} ({guess})" if guess else text


def _looks_like(data: bytes) -> str:
    zeros, ones = data.count(0x00) / len(data), sum(byte >= 0xF8 for byte in data) / len(data)
    high = any(byte & 0x80 for byte in data)
    if zeros > EVERY_OTHER:
        return "zeros: wires A and B swapped, a break, or a sender slower than this port"
    if ones > EVERY_OTHER:
        return "ones: a floating line that needs biasing, or a sender faster than this port"
    if high and all(byte.bit_count() % 2 == 0 for byte in data):
        return "7 bits with even parity: try ?bytesize=7&parity=E"
    if high and all(byte.bit_count() % 2 == 1 for byte in data):
        return "7 bits with odd parity: try ?bytesize=7&parity=O"
    return ""


# The nodes


def nodes(records: Sequence[Record], timing: ReplyTiming) -> Iterator[Finding]:
    """Return a finding for each node, and compare their latencies with the configured reply times."""
    for record in records:
        others = [other for other in records if other is not record and other.lives]
        clean = bool(others) and not any(other.count(Outcome.GARBLED) for other in others)
        yield node(record, others_are_clean=clean)
    starts = [start for record in records for start in record.starts]
    if starts:
        yield windows(starts, timing)
        yield learning(starts, timing)


def learning(starts: Sequence[float], timing: ReplyTiming) -> Finding:
    """Return the windows that learned reply times would have with these latencies, in seconds."""
    slowest = max(starts)
    window = min(window_of(slowest, slowest), timing.window)
    if window >= timing.window:
        return Finding("learning", True, "learned windows would not be shorter than the configured one")
    return Finding(
        "learning",
        True,
        f"learned windows would be {milliseconds(window)} ms at most; a lost reply would occupy the line for about as "
        f'long, instead of {milliseconds(timing.max_reply_delay)} ms (--timeout learned, timing = "learned")',
    )


def node(record: Record, others_are_clean: bool) -> Finding:
    """Return the finding for one node; `others_are_clean` separates a fault of this node from one of the line."""
    asked, garbled, silent = len(record.probes), record.count(Outcome.GARBLED), record.count(Outcome.SILENT)
    label, who = record.label, f"another node with {_address_of(record)}"
    if record.doubled:
        return Finding(
            label,
            False,
            f"more than one reply to {record.doubled} of {asked} requests: there is {who}",
            "switch one off and find the other, then give each its own address",
        )
    if garbled:
        probe = next(probe for probe in record.probes if probe.outcome is Outcome.GARBLED)
        what = f"{garbled} of {asked} replies garbled ({probe.text}): {garbage(probe.raw)}"
        if probe.hint is not None:
            advice = probe.hint
        elif others_are_clean:
            advice = f"look for {who}: does this one still reply when you switch it off? Else check its wiring"
        else:
            advice = "check baud rate, termination, biasing and the common ground; then check for a shared address"
        return Finding(label, False, what, advice)
    if silent == asked:
        return Finding(label, False, "does not reply", "check its address, power, wiring and protocol")
    text = record.answers[0].text
    if silent:
        return Finding(
            label,
            False,
            f"no reply to {silent} of {asked} requests, although it is alive: {text}",
            "look for a loose contact or terminal, or another load on the node; then for its bus load",
        )
    starts = record.starts
    times = " / ".join(milliseconds(value) for value in (starts[0], median(starts), percentile(starts)))
    return Finding(label, True, f"replies after {times} ms (least / median / p99 of {asked}): {text}")


def _address_of(record: Record) -> str:
    return f"address {record.address}" if record.label != "the drive" else "no address on this line"


def windows(starts: Sequence[float], timing: ReplyTiming) -> Finding:
    """Return the finding that compares measured latencies, in seconds, with the configured reply times."""
    slow = percentile(sorted(starts))
    times = " / ".join(milliseconds(value) for value in (timing.late_after, timing.window, timing.max_reply_delay))
    what = f"replies begin within {milliseconds(slow)} ms; set are {times} ms (late_after / window / max_reply_delay)"
    window = max(rounded_up(3 * slow), SHORTEST_WINDOW)
    if slow > timing.window:
        max_reply_delay = max(timing.max_reply_delay, rounded_up(1.5 * window))
        wanted = " / ".join(milliseconds(value) for value in (rounded_up(1.5 * slow), window, max_reply_delay))
        advice = f"their values arrive late; use {wanted} ms, or --timeout {milliseconds(window)}"
        return Finding("windows", False, what, advice)
    if slow > timing.late_after:
        late_after = milliseconds(rounded_up(1.5 * slow))
        return Finding("windows", True, what, f"they are counted late; late_after = {late_after} ms would fit")
    max_reply_delay = rounded_up(1.5 * window)
    if max_reply_delay < timing.max_reply_delay:
        times = f"timing = {{ window = {window:g}, max_reply_delay = {max_reply_delay:g} }}"
        advice = f"{times} in LINE.toml would waste less time on dead nodes, but leave a margin for busy ones"
        return Finding("windows", True, what, advice)
    return Finding("windows", True, what)


def turnaround(starts: Sequence[float], released: Sequence[float] | None, byte_time: float) -> Iterator[Finding]:
    """Report how fast RTS releases the line after a request, as far as that can be measured.

    `starts`: seconds from the end of each request to the first byte of its reply. `released`: those to the release of
    the line by software; None if the driver does that, which no program can observe. A byte is received at its end.
    """
    begun = max(0.0, min(starts) - byte_time) if starts else None
    if released is None:
        if begun is not None:
            what = f"the line was free {milliseconds(begun)} ms after the last bit at the latest: a reply began then"
            yield Finding("turnaround", True, what, "the driver does not report when it releases the line")
    elif released:
        times = sorted(max(0.0, seconds) for seconds in released)
        shown = " / ".join(map(milliseconds, (times[0], median(times), percentile(times))))
        what = (
            f"software releases the line {shown} ms after the calculated end of the last bit (least / median / p99 of "
            f"{len(times)})"
        )
        if begun is None or times[-1] < begun:
            yield Finding("turnaround", True, what)
        else:
            yield Finding(
                "turnaround",
                False,
                f"{what}, but a reply began after {milliseconds(begun)} ms: the transmitter can damage it",
                "shorten rs485.delay_after, have the drive reply later, or use a driver or an adapter that switches",
            )


def nobody(asked: str, profile: Profile, settings: LineSettings | None) -> Finding:
    """Return the finding that no node has replied. `asked` names them, as in "nodes 1-4"."""
    at = "" if settings is None else f" at {speed(settings)}"
    return Finding(
        "nodes",
        False,
        f"no reply from {asked}{at}",
        "check power, wires A and B (swap them), common ground, termination, the addresses, and that they use "
        f"{profile.title}",
    )


def other_rate(address: int | None, settings: LineSettings, asked: str, tried: int) -> Finding:
    """Return the result of other settings; `settings` are those at which the node `address` replied, if one did."""
    if address is None:
        what = f"{asked}: no reply with {tried} other settings either"
        return Finding("settings", False, what, "name your nodes with --nodes if these are not among them")
    advice = f"add ?baudrate={settings.baudrate}&bytesize={settings.bytesize}&parity={settings.parity} to the port"
    return Finding("settings", False, f"{asked}: node {address} replies at {speed(settings)}", advice)


def percentile(ordered: Sequence[float], share: float = 0.99) -> float:
    """Return, of at least one value, in order, the smallest that such a share of them (0 to 1) are not above."""
    return ordered[math.ceil(share * len(ordered)) - 1]


def rounded_up(seconds: float) -> float:
    """Round a time in seconds up to a whole STEP."""
    return math.ceil(seconds / STEP - 1e-9) * STEP


def milliseconds(seconds: float) -> str:
    """Write seconds as milliseconds, with one decimal below 10 ms, and without a needless zero."""
    value = seconds * 1000
    return f"{value:.1f}".removesuffix(".0") if value < 10 else f"{value:.0f}"


def speed(settings: LineSettings) -> str:
    """Return the baud rate and the framing in a few words."""
    return f"{settings.baudrate} {settings.framing}"
