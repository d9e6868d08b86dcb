"""The one place where the state of a line changes.

Theory of operation
-------------------
One half-duplex line, many nodes, anonymous replies. The arbiter keeps one exchange on the line at most (R1), and
between exchanges it makes sure that no byte of an earlier one can still come (R3). It is told the time with every
call; it sends nothing itself: the owner pumps `poll_transmit`, then `poll_event`, then arms a timer for
`poll_timeout`. Calls that come early or twice change nothing.

The line is in one of five states; `_line_due` is when the state ends by itself.

=========  =====================  =======================  ==========================  ====================
state      data received          its deadline             line_up / line_down         submit, poll due
=========  =====================  =======================  ==========================  ====================
OFFLINE    counted, dropped       never                    up: SETTLING                fails with LineDown
READY      stray: SETTLING        never                    down: OFFLINE               EXCHANGE
HOLDOFF    stray: SETTLING        READY                    down: OFFLINE, all fail     waits
EXCHANGE   read: stays, or ends   window or gap is over:   down: OFFLINE, all fail     waits
           in READY, HOLDOFF      failed (SETTLING), next
           or SETTLING            leg, or done (broadcast)
SETTLING   stray: silence starts  READY                    down: OFFLINE, all fail     waits (NOISY: fails)
           again; 1 s of it:
           NOISY, all fail
=========  =====================  =======================  ==========================  ====================

READY never lasts while something waits: whatever leads to READY starts the next transaction in the same call.
An exchange ends in READY or HOLDOFF only when its outcome is certain: a reply that matches, with nothing behind it; a
NAK to a write; or a whole frame with the right echo whose checksum is bad. Everything else settles.

What goes next and what becomes of a failed attempt is the dispatcher's business (dispatcher.py).
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

from busmaster.arbiter.counters import LineCounters, LineStatistics
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.events import (
    Event,
    LatenessRaised,
    LineChange,
    LineChanged,
    LineState,
    Strayed,
)
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.schedule import Poll
from busmaster.arbiter.transaction import Transaction
from busmaster.errors import BusClosed, BusError, LineDown, LineNoisy, Refused
from busmaster.exchange import MORE, Done, Exchange, Expect, FrameError, Listener, ReplyTiming, Step, Timings
from busmaster.profile import Profile

QUIET = 0.020
"""The least silence, in seconds, that ends a settle."""
NOISY_AFTER = 1.0
"""Seconds without such a silence after which the line is NOISY."""
TAINT_SHARE = 0.9
"""A reply cannot begin before this share of its request's own wire time (R4)."""
STRAGGLER_SHARE = 0.75
STRAGGLER_MARGIN = 1.6
LONGEST_LATENESS = 0.5
STRAGGLER_MEMORY = 1.0
"""Seconds after which a stray byte is no longer blamed on the last unanswered request."""
UNKNOWN_LATENESS = 0.150
"""Assumed of an earlier master's nodes while none is known."""
EARLY = 1e-9
"""Rounding of a deadline that was computed and is given back as the time."""


class Arbiter:
    """The arbiter of one line. `byte_time` is tau, in seconds."""

    def __init__(
        self,
        byte_time: float,
        *,
        now: float = 0.0,
        echo: bool = False,
        receive_latency: float = 0.0,
        capacity: int = 1000,
        jitter: Callable[[], float] = lambda: 0.5,
    ) -> None:
        self.byte_time = byte_time
        self.state = LineState.OFFLINE
        self.noisy = False
        self._echo = echo
        self._paced = False
        self._receive_latency = receive_latency
        self._deadlines = Deadlines()
        self._counters = LineCounters(now)
        self._dispatch = Dispatcher(self._deadlines, self._counters, now, capacity, jitter)
        self._dispatch.fault = self._offline
        self._events = self._dispatch.events
        self._cause = "not open yet"
        self._closed = False
        self._out = b""
        # the exchange on the wire
        self._transaction: Transaction | None = None
        self._exchange: Exchange[Any] | None = None
        self._timing = ReplyTiming(0.0, 0.0, UNKNOWN_LATENESS, QUIET)
        self._begun = False
        self._leg_end = -inf
        self._leg_limit = inf
        self._taint_until = -inf
        self._strayed_within = False
        # the line
        self._echo_owed = b""
        self._last_byte = -inf
        self._since = now
        self._up_at = -inf
        self._quarantine = -inf
        self._noise_since = inf
        self._unanswered: tuple[NodeRecord, float, float] | None = None
        self._listener: Listener | None = None
        self._listening = False

    # commands

    def add_node(
        self, profile: Profile, address: int, now: float, timings: Timings | None = None, retries: int | None = None
    ) -> NodeRecord:
        """Raises InvalidCommand for an address that the protocol does not have."""
        profile.check_address(address)
        node = NodeRecord(
            profile,
            address,
            profile.timings if timings is None else timings,
            profile.retries if retries is None else retries,
        )
        self._dispatch.nodes.append(node)
        if profile.listen is not None and self._listener is None:
            self._listener = profile.listen()
        self._quarantine = max(self._quarantine, self._up_at + node.lateness)
        return node

    def submit(self, transaction: Transaction, now: float) -> None:
        self._dispatch.submit(transaction, now)
        if self.state is LineState.READY:
            self._advance(now)

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Synchronous; never touches the line (R6)."""
        self._dispatch.cancel(transaction, now)

    def add_poll(self, poll: Poll, now: float) -> None:
        self._dispatch.add_poll(poll, now)

    def remove_poll(self, poll: Poll, now: float) -> None:
        self._dispatch.remove_poll(poll, now)

    def demand(self, poll: Poll, now: float) -> None:
        """One cycle now, off the grid."""
        self._dispatch.demand(poll, now)
        if self.state is LineState.READY:
            self._advance(now)

    def suspend(self, node: NodeRecord, until: float) -> None:
        self._dispatch.suspend(node, until)

    def release_node(self, node: NodeRecord) -> None:
        self._dispatch.release_node(node)

    def probe_soon(self, node: NodeRecord, now: float) -> None:
        self._dispatch.probe_soon(node, now)

    def close(self, now: float) -> None:
        """Fail whatever waits with BusClosed. The exchange on the wire runs out; then the line is OFFLINE."""
        if self._closed:
            return
        self._closed = True
        self._dispatch.fault = lambda: BusClosed("the bus was closed")
        for poll in list(self._dispatch.schedule.polls):
            self._dispatch.remove_poll(poll, now)
        self._dispatch.fail_all(now)
        if self.state is not LineState.EXCHANGE:
            self._go_offline(now)

    # inputs

    def line_up(self, now: float, *, paced: bool = False) -> None:
        """The port is open. What an earlier master asked may still be answered: settle first.

        `paced`: bytes leave at the baud rate, so that an earlier reply cannot be one (R4).
        """
        if self.state is not LineState.OFFLINE or self._closed:
            return
        self._paced = paced
        self._dispatch.fault = None
        self._events.append(LineChanged(LineChange.UP))
        lateness = max((node.lateness for node in self._dispatch.nodes), default=UNKNOWN_LATENESS)
        self._up_at = self._since = now
        self._quarantine = now + lateness
        self._settle(now)

    def line_down(self, cause: str, now: float) -> None:
        """The port is gone: everything fails at once (R13)."""
        if self.state is LineState.OFFLINE:
            return
        self._counters.losses += 1
        self._cause = cause
        self._events.append(LineChanged(LineChange.DOWN, cause))
        if not self._closed:
            self._dispatch.fault = self._offline
        self._go_offline(now)
        self._dispatch.fail_all(now)

    def data_received(self, data: bytes, now: float) -> None:
        if self._echo_owed:
            data = self._strip_echo(data, now)
            if not data:
                return
        if self.state is LineState.EXCHANGE:
            self._read(data, now)
        else:
            self._stray(data, now)

    def handle_timeout(self, now: float) -> None:
        deadlines = self._deadlines
        now += EARLY
        if now >= deadlines.schedule:
            self._dispatch.release_polls(now)
        if now >= deadlines.expiry:
            self._dispatch.expire(now)
        if now >= deadlines.health:
            self._dispatch.probe(now)
        if now >= deadlines.line:
            if self.state is LineState.EXCHANGE:
                self._expire(now)
            else:
                self._free(now)
        elif self.state is LineState.READY:
            self._advance(now)

    # outputs, pumped in this order

    def poll_transmit(self) -> bytes | None:
        data = self._out
        if not data:
            return None
        self._out = b""
        return data

    def poll_event(self) -> Event | None:
        return self._events.popleft() if self._events else None

    def poll_timeout(self) -> float:
        return self._deadlines.earliest()

    @property
    def idle(self) -> bool:
        """Nothing is on the wire."""
        return self.state is not LineState.EXCHANGE

    def reset_statistics(self, now: float) -> None:
        self._counters.reset(now)
        for node in self._dispatch.nodes:
            node.counters.reset()

    def statistics(self, now: float) -> LineStatistics:
        busy, settling = self._counters.busy, self._counters.settling
        if self.state is LineState.SETTLING:
            settling += now - self._since
        elif self.state in (LineState.EXCHANGE, LineState.HOLDOFF):
            busy += now - self._since
        return self._counters.snapshot(now, busy, settling, len(self._dispatch.backlog))

    # one exchange

    def _advance(self, now: float) -> None:
        """The line is free: start the next transaction, if one waits."""
        if now < self._quarantine:
            self._settle(now)
            return
        transaction = self._dispatch.next(now)
        if transaction is None:
            return
        node = transaction.node
        exchange = transaction.command.open(node.address, node.timings)
        if now > self._since:
            self._dispatch.idle(now - self._since)
        self._dispatch.started(transaction, now)
        self._transaction = transaction
        self._exchange = exchange
        self._since = now
        self._strayed_within = False
        self.state = LineState.EXCHANGE
        self._begin_leg(exchange.timing, exchange.sizes.longest, exchange.request, now)
        if not exchange.answered:
            self._deadlines.line = self._leg_end + exchange.timing.turnaround

    def _begin_leg(self, timing: ReplyTiming, longest: int, send: bytes, now: float) -> None:
        """Say `send`; its reply must begin within the window, and end within the bound of R2."""
        byte_time = self.byte_time
        length = len(send) * byte_time
        end = now + length
        self._timing = timing
        self._begun = False
        self._leg_end = end
        due = end + timing.window + self._receive_latency
        self._deadlines.line = due
        self._leg_limit = due + longest * byte_time + timing.byte_gap
        if send:
            self._out += send
            if self._echo:
                self._echo_owed += send
            elif self._paced:
                self._taint_until = now + TAINT_SHARE * length

    def _read(self, data: bytes, now: float) -> None:
        """Bytes while an exchange is on the wire."""
        transaction, exchange = self._transaction, self._exchange
        assert transaction is not None
        assert exchange is not None
        if not self._begun:
            data = self._begin_reply(transaction, exchange, data, now)
            if not data:
                return
        self._last_byte = now
        try:
            self._follow(exchange.feed(data), now)
        except FrameError as error:
            self._attempt_failed(error, now)
        except Refused as refusal:
            self._refused(refusal, now)
        except Exception as error:
            self._attempt_failed(FrameError(f"a bug in the protocol's reader: {error!r}"), now)

    def _begin_reply(self, transaction: Transaction, exchange: Exchange[Any], data: bytes, now: float) -> bytes:
        """The first bytes of a leg: returns those that may be its reply."""
        if now < self._taint_until:
            self._counters.tainted += 1
            self._last_byte = now
            self._attempt_failed(FrameError("bytes came before the request was out"), now)
            return b""
        if not exchange.answered:
            self._note_strays(data, now)
            self._strayed_within = True
            return b""
        if transaction.node.profile.noise_tolerant:
            kept = data.lstrip(bytes(set(data) - set(exchange.starts)))
            self._counters.noise_bytes += len(data) - len(kept)
            if not kept:
                return b""
            data = kept
        self._begun = True
        if transaction.first_byte == -inf:
            transaction.first_byte = now
        if now > self._leg_end + self._timing.nominal + self._receive_latency:
            transaction.late = True
        return data

    def _follow(self, step: Step[Any], now: float) -> None:
        """What the reader makes of the bytes: more, another leg, or the end."""
        while step is not MORE:
            if type(step) is Done:
                self._complete(step, now)
                return
            assert type(step) is Expect
            assert self._exchange is not None
            self._next_leg(step, now)
            step = self._exchange.feed(b"")
        if self._begun:
            gap_over = now + self._timing.byte_gap + self._receive_latency
            self._deadlines.line = gap_over if gap_over < self._leg_limit else self._leg_limit

    def _next_leg(self, step: Expect, now: float) -> None:
        """Raises FrameError instead, where a repeat would hold the line past its limit or an urgent command (R9)."""
        transaction = self._transaction
        assert transaction is not None
        limit = transaction.node.profile.exchange_limit
        if step.send and limit is not None and (now - self._since > limit or self._dispatch.urgent_waits()):
            raise self._exchange.abandon()  # type: ignore[union-attr]  # profiles with a limit have it
        self._begin_leg(step.timing, step.sizes.longest, step.send, now)

    def _complete(self, step: Done[Any], now: float) -> None:
        """A value: the line is free when the closing ACK has left and the node has let go of the line."""
        transaction = self._transaction
        assert transaction is not None
        transaction.last_byte = now
        free = now
        if step.send:
            free = self._say(step.send, now)
        self._end_exchange(now)
        self._dispatch.succeeded(transaction, step.value, now)
        if step.rest:
            self._note_strays(step.rest, now)
        if step.rest or self._strayed_within:
            self._settle(now)
            return
        self._unanswered = None
        self._release_at(free + self._timing.turnaround, now)

    def _attempt_failed(self, error: FrameError, now: float, no_reply: bool = False) -> None:
        transaction = self._transaction
        assert transaction is not None
        what = error.what
        if no_reply:
            self._unanswered = (transaction.node, self._leg_end, self._timing.lateness)
            what = f"no reply within {self._timing.window * 1000:g} ms"
            if self._echo_owed:
                what += ", and no echo of the request, though the port says echo"
        elif self._unanswered is not None and not error.whole:
            self._blame_straggler(now)
        free = self._say(error.send, now) if error.send else now
        self._end_exchange(now)
        self._dispatch.attempt_failed(transaction, no_reply, what, now)
        if error.whole:
            self._release_at(free + self._timing.turnaround, now)
        else:
            self._settle(now)

    def _refused(self, refusal: Refused, now: float) -> None:
        """A NAK to a write is certain; a NAK to a read may be noise before the true reply (R7)."""
        transaction = self._transaction
        assert transaction is not None
        transaction.last_byte = now
        self._end_exchange(now)
        self._dispatch.refused(transaction, refusal, now)
        if transaction.writes:
            self._release_at(now + self._timing.turnaround, now)
        else:
            self._settle(now)

    def _expire(self, now: float) -> None:
        """The window, a byte gap or the leg's bound ran out."""
        exchange = self._exchange
        assert exchange is not None
        begun = self._begun
        try:
            self._follow(exchange.expired(begun), now)
        except FrameError as error:
            self._attempt_failed(error, now, no_reply=not begun)
        except Refused as refusal:
            self._refused(refusal, now)

    def _say(self, send: bytes, now: float) -> float:
        """Send what closes an exchange; returns when it is out."""
        self._out += send
        if self._echo:
            self._echo_owed += send
        self._leg_end = now + len(send) * self.byte_time
        return self._leg_end

    def _end_exchange(self, now: float) -> None:
        self._transaction = None
        self._exchange = None
        self._counters.busy += now - self._since
        self._since = now

    # the line between exchanges

    def _release_at(self, free: float, now: float) -> None:
        """The outcome was certain: the next exchange may start at `free`."""
        if self._closed:
            self._go_offline(now)
        elif free > now:
            self.state = LineState.HOLDOFF
            self._deadlines.line = free
        else:
            self.state = LineState.READY
            self._deadlines.line = inf
            self._advance(now)

    def _settle(self, now: float) -> None:
        """Discard until it has been silent long enough and nothing can come any more (R3)."""
        if self._closed:
            self._go_offline(now)
            return
        timing = self._timing
        if self.state is not LineState.SETTLING:
            self._counters.settles += 1
            if self.state is LineState.HOLDOFF:
                self._counters.busy += now - self._since
            self._since = now
            self.state = LineState.SETTLING
        self._echo_owed = b""
        quiet = max(QUIET, timing.byte_gap)
        certain = self._leg_end + timing.lateness + self._receive_latency
        self._deadlines.line = max(certain, self._last_byte + quiet, self._quarantine, now)

    def _free(self, now: float) -> None:
        """A holdoff or a settle is over."""
        if self.state is LineState.SETTLING:
            self._counters.settling += now - self._since
            self._noise_since = inf
            if self._listening and self._finish_listening(now):
                return
            if self.noisy:
                self.noisy = False
                self._dispatch.fault = None
                self._events.append(LineChanged(LineChange.QUIET))
        elif self.state is LineState.HOLDOFF:
            self._counters.busy += now - self._since
        self._since = now
        self.state = LineState.READY
        self._deadlines.line = inf
        self._advance(now)

    def _stray(self, data: bytes, now: float) -> None:
        """Bytes that nobody asked for."""
        self._note_strays(data, now)
        if self.state is LineState.OFFLINE:
            return
        if self._noise_since == inf:
            self._noise_since = now
        self._settle(now)
        if self._listener is not None:
            self._listen(self._listener, data, now)
        if now - self._noise_since >= NOISY_AFTER and not self.noisy:
            self.noisy = True
            self._counters.noisy += 1
            self._events.append(LineChanged(LineChange.NOISY))
            self._dispatch.fault = lambda: LineNoisy("the line has not been silent for a second")
            self._dispatch.fail_all(now)

    def _note_strays(self, data: bytes, now: float) -> None:
        self._counters.stray_bytes += len(data)
        self._events.append(Strayed(data))
        quiet = max(QUIET, self._timing.byte_gap)
        if now - self._last_byte > quiet:
            self._noise_since = now
        self._last_byte = now
        if self._unanswered is not None:
            self._blame_straggler(now)

    def _blame_straggler(self, first_byte: float) -> None:
        """A reply came long after its request: its node is slower than was believed (R3)."""
        assert self._unanswered is not None
        node, asked, lateness = self._unanswered
        self._unanswered = None
        age = first_byte - asked
        raised = min(STRAGGLER_MARGIN * age, LONGEST_LATENESS)
        if STRAGGLER_SHARE * lateness < age <= STRAGGLER_MEMORY and raised > lateness:
            node.timings = node.timings.with_lateness(raised)
            self._events.append(LatenessRaised(node, age, raised))

    def _listen(self, listener: Listener, data: bytes, now: float) -> None:
        """What comes unasked may be owed an answer (MSC: a packet sent again until it is ACKed)."""
        try:
            step = listener.feed(data)
        except FrameError as error:
            self._listening = False
            send = error.send
        else:
            self._listening = step is MORE
            send = step.send if isinstance(step, Done) else b""
        if send:
            self._say(send, now)
            self._settle(now)

    def _finish_listening(self, now: float) -> bool:
        """A packet was cut in mid-frame; True if it must be answered, and the line settles again."""
        assert self._listener is not None
        self._listening = False
        send = self._listener.expired().send
        if send:
            self._since = now
            self._say(send, now)
            self._settle(now)
        return bool(send)

    def _strip_echo(self, data: bytes, now: float) -> bytes:
        """Take the echo of what was sent off the front, byte for byte; a mismatch is a collision."""
        owed = self._echo_owed
        length = min(len(owed), len(data))
        if data[:length] != owed[:length]:
            self._counters.collisions += 1
            self._events.append(Strayed(data, collision=True))
            self._last_byte = now
            self._echo_owed = b""
            if self.state is LineState.EXCHANGE:
                self._attempt_failed(FrameError("the echo differs from what was sent: a collision"), now)
            else:
                self._settle(now)
            return b""
        self._echo_owed = owed[length:]
        if not self._echo_owed and self.state is LineState.EXCHANGE and not self._begun:
            answered = self._exchange is not None and self._exchange.answered
            late = now - self._leg_end
            self._leg_end = now
            self._leg_limit += late
            wait = self._timing.window + self._receive_latency if answered else self._timing.turnaround
            self._deadlines.line = now + wait
        return data[length:]

    def _go_offline(self, now: float) -> None:
        """Whatever is on the wire is cut off."""
        transaction = self._transaction
        if self.state is LineState.SETTLING:
            self._counters.settling += now - self._since
        self.state = LineState.OFFLINE
        self.noisy = False
        self._deadlines.line = inf
        self._out = b"" if transaction is not None else self._out
        self._echo_owed = b""
        self._unanswered = None
        self._noise_since = inf
        if transaction is not None:
            self._end_exchange(now)
            self._dispatch.cut_off(transaction, self._offline(), now)

    def _offline(self) -> BusError:
        return LineDown(f"the line is down: {self._cause}")
