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
from typing import Any, cast

from busmaster.arbiter.counters import LineCounters, LineStatistics
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.echo import Echo
from busmaster.arbiter.events import Event, LineChange, LineChanged, Strayed
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.leg import Leg
from busmaster.arbiter.schedule import Poll
from busmaster.arbiter.state import EXCHANGE, HOLDOFF, OFFLINE, READY, SETTLING, LineState
from busmaster.arbiter.strays import QUIET, Strays
from busmaster.arbiter.transaction import Transaction
from busmaster.errors import BusClosed, BusError, LineDown, LineNoisy, Refused
from busmaster.exchange import NO_REPLY, Abandonable, Done, Exchange, Expect, FrameError, ReplyTiming, Timings
from busmaster.profile import Profile

UNKNOWN_LATENESS = 0.150
"""Assumed of an earlier master's nodes while none is known."""


class Arbiter:
    """The arbiter of one line. `byte_time` is tau, in seconds. What never touches the line is its `dispatcher`'s."""

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
        self.state = OFFLINE
        self.noisy = False
        self._echo = Echo(echo)
        self._paced = False
        self._deadlines = Deadlines()
        self._counters = LineCounters(now)
        self.dispatcher = Dispatcher(self._deadlines, self._counters, now, capacity, jitter)
        self.dispatcher.fault = self._offline
        self._events = self.dispatcher.events
        self._cause = "not open yet"
        self._closed = False
        self._out = b""
        # the exchange on the wire
        self._transaction: Transaction | None = None
        self._exchange: Exchange[Any] | None = None
        self._leg = Leg(ReplyTiming(0.0, 0.0, UNKNOWN_LATENESS, QUIET), receive_latency)
        self._strayed_within = False
        # the line
        self._strays = Strays(self._events, self._counters)
        self._up_at = -inf
        self._quarantine = -inf

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
        self.dispatcher.nodes.append(node)
        if profile.listen is not None and self._strays.listener is None:
            self._strays.listener = profile.listen()
        self._quarantine = max(self._quarantine, self._up_at + node.lateness + self._leg.latency)
        return node

    def submit(self, transaction: Transaction, now: float) -> bool:
        """False if it waits and nothing else has changed: then there is nothing to pump."""
        waits = self.dispatcher.submit(transaction, now)
        if self.state is READY:
            self._advance(now)
            return True
        return not waits or transaction.writes or transaction.start_by < inf

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Synchronous; never touches the line (R6)."""
        self.dispatcher.cancel(transaction, now)

    def add_poll(self, poll: Poll, now: float) -> None:
        """Its first cycle waits until a line that has just been opened can be used."""
        self.dispatcher.add_poll(poll, max(now, self._quarantine))

    def remove_poll(self, poll: Poll, now: float) -> None:
        self.dispatcher.remove_poll(poll, now)

    def demand(self, poll: Poll, now: float) -> None:
        """One cycle now, off the grid."""
        self.dispatcher.demand(poll, now)
        if self.state is READY:
            self._advance(now)

    def close(self, now: float) -> None:
        """Fail whatever waits with BusClosed. The exchange on the wire runs out; then the line is OFFLINE."""
        if self._closed:
            return
        self._closed = True
        self.dispatcher.fault = lambda: BusClosed("the bus was closed")
        for poll in list(self.dispatcher.schedule.polls):
            self.dispatcher.remove_poll(poll, now)
        self.dispatcher.fail_all(now)
        if self.state is not EXCHANGE:
            self._go_offline(now)

    # inputs

    def line_up(self, now: float, *, paced: bool = False) -> None:
        """The port is open. What an earlier master asked may still be answered: settle first.

        `paced`: bytes leave at the baud rate, so that an earlier reply cannot be one (R4).
        """
        if self.state is not OFFLINE or self._closed:
            return
        self._paced = paced
        self.dispatcher.fault = None
        self._events.append(LineChanged(LineChange.UP))
        lateness = max((node.lateness for node in self.dispatcher.nodes), default=UNKNOWN_LATENESS)
        self._up_at = now
        self._quarantine = now + lateness + self._leg.latency
        self._settle(now)

    def line_down(self, cause: str, now: float) -> None:
        """The port is gone: everything fails at once (R13)."""
        if self.state is OFFLINE:
            return
        self._counters.losses += 1
        self._cause = cause
        self._events.append(LineChanged(LineChange.DOWN, cause))
        if not self._closed:
            self.dispatcher.fault = self._offline
        self._go_offline(now)
        self.dispatcher.fail_all(now)

    def data_received(self, data: bytes, now: float) -> None:
        if self._echo.owed:
            data = self._strip_echo(data, now)
            if not data:
                return
        if self.state is not EXCHANGE:
            self._stray(data, now)
        elif self._leg.begun or (data := self._begin_reply(data, now)):
            self._strays.last_byte = now
            self._take(data, now)

    def handle_timeout(self, now: float, *, unread: bool = False) -> None:
        """`unread`: bytes have come that were not handed over yet, so the silence of the line is not known."""
        deadlines = self._deadlines
        if now >= deadlines.schedule:
            self.dispatcher.release_polls(now)
        if now >= deadlines.expiry:
            self.dispatcher.expire(now)
        if now >= deadlines.health:
            self._enter(self.state, now)
            self.dispatcher.probe(now)
        if now >= deadlines.line and not unread:
            if self.state is EXCHANGE:
                self._take(None, now)
            else:
                self._free(now)
        elif self.state is READY:
            self._advance(now)

    # outputs, pumped in this order

    def poll_transmit(self) -> bytes | None:
        data, self._out = self._out, b""
        return data or None

    def poll_event(self) -> Event | None:
        if self.dispatcher.unnoted:
            self.dispatcher.note_successes()
        return self._events.popleft() if self._events else None

    def poll_timeout(self) -> float:
        return self._deadlines.earliest()

    def reset_statistics(self, now: float) -> None:
        self._counters.reset(self.state, now)
        for node in self.dispatcher.nodes:
            node.counters.reset()

    def statistics(self, now: float) -> LineStatistics:
        return self._counters.snapshot(self.state, now, len(self.dispatcher.backlog))

    # one exchange

    def _advance(self, now: float, free: float = -inf) -> bool:
        """Start the next transaction, right behind our own last byte, which is out at `free`. False if none waits."""
        if now < self._quarantine:
            self._settle(now)
            return True
        while (transaction := self.dispatcher.next(now)) is not None:
            node = transaction.node
            try:
                exchange = transaction.command.open(node.address, node.timings)
            except Exception as bug:
                self.dispatcher.unsendable(transaction, bug, now)
            else:
                break
        else:
            return False
        self.dispatcher.started(transaction, now)
        self._transaction = transaction
        self._exchange = exchange
        self._strayed_within = False
        if self.state is not EXCHANGE:
            self._enter(EXCHANGE, now)
        self._begin_leg(exchange.timing, exchange.sizes.longest, exchange.request, free if free > now else now)
        if not exchange.answered:
            self._deadlines.line = self._leg.end + exchange.timing.turnaround
        return True

    def _begin_leg(self, timing: ReplyTiming, longest: int, send: bytes, now: float) -> None:
        """Say `send`; its reply must begin within the window, and end within the bound of R2."""
        byte_time = self.byte_time
        said = len(send) * byte_time
        self._deadlines.line = self._leg.begin(timing, said, longest * byte_time, now)
        if send:
            self._out += send
            if self._echo.declared:
                self._echo.sent(send)
            elif self._paced:
                self._leg.taint(said, now)

    def _begin_reply(self, data: bytes, now: float) -> bytes:
        """The first bytes of a leg: returns those that may be its reply."""
        transaction, exchange, leg = self._transaction, self._exchange, self._leg
        assert transaction is not None
        assert exchange is not None
        if now < leg.taint_until:
            self._counters.tainted += 1
            self._strays.last_byte = now
            self._attempt_failed(FrameError("bytes came before the request was out"), now)
            return b""
        if not exchange.answered:
            self._strays.note(data, now, self._leg.quiet())
            self._strayed_within = True
            return b""
        if transaction.node.profile.noise_tolerant:
            kept = data.lstrip(bytes(set(data) - set(exchange.starts)))
            self._counters.noise_bytes += len(data) - len(kept)
            self._strays.last_byte = now
            if not kept:
                return b""
            data = kept
        leg.begun = True
        if transaction.first_byte == -inf:
            transaction.first_byte = now
        if now > leg.late_after:
            transaction.late = True
        return data

    def _take(self, data: bytes | None, now: float) -> None:
        """Hand the reader these bytes, or the news (None) that none came in time, and do what it makes of them."""
        exchange = self._exchange
        assert exchange is not None
        no_reply = data is None and not self._leg.begun
        try:
            step = exchange.expired(self._leg.begun) if data is None else exchange.feed(data)
            while type(step) is Expect:
                self._next_leg(step, now)
                step = exchange.feed(b"")
        except FrameError as error:
            self._attempt_failed(error, now, no_reply=no_reply)
        except Refused as refusal:
            self._refused(refusal, now)
        except Exception as bug:
            self._attempt_failed(FrameError(f"a bug in the protocol's reader: {bug!r}"), now)
        else:
            if type(step) is Done:
                self._complete(step, now)
            elif self._leg.begun:
                self._deadlines.line = self._leg.gap_over(now)

    def _next_leg(self, step: Expect, now: float) -> None:
        """Raises FrameError instead, where a repeat would hold the line past its limit or an urgent command (R9)."""
        transaction = self._transaction
        assert transaction is not None
        limit = transaction.node.profile.exchange_limit
        if step.send and limit is not None and (now - transaction.started > limit or self.dispatcher.urgent_waits()):
            raise cast("Abandonable", self._exchange).abandon()
        self._begin_leg(step.timing, step.sizes.longest, step.send, now)

    def _complete(self, step: Done[Any], now: float) -> None:
        """A value: the line is free when the closing ACK has left and the node has let go of the line."""
        transaction = self._transaction
        assert transaction is not None
        answered = self._exchange is not None and self._exchange.answered
        free = self._say(step.send, now) if step.send else now
        self._end_exchange()
        self.dispatcher.succeeded(transaction, step.value, now)
        if step.rest:
            self._strays.note(step.rest, now, self._leg.quiet())
        if step.rest or self._strayed_within or (self._echo.owed and not answered):
            self._settle(now)
            return
        self._strays.answered()
        self._release(free, self._leg.timing.turnaround if answered else 0.0, now)

    def _attempt_failed(self, error: FrameError, now: float, no_reply: bool = False) -> None:
        transaction = self._transaction
        assert transaction is not None
        what = error.what
        if no_reply:
            self._strays.unanswered(transaction.node, self._leg.end, self._leg.timing.lateness)
            if what == NO_REPLY:
                what = f"no reply within {self._leg.timing.window * 1000:g} ms"
            if self._echo.owed:
                what += ", and no echo of the request: if the adapter has none, leave echo out"
        elif not error.whole:
            self._strays.blame(now)
        free = self._say(error.send, now) if error.send else now
        self._end_exchange(failed=True)
        self.dispatcher.attempt_failed(transaction, no_reply, what, now)
        if error.whole:
            self._release(free, self._leg.timing.turnaround, now)
        else:
            self._settle(now)

    def _refused(self, refusal: Refused, now: float) -> None:
        """A NAK to a write is certain; a NAK to a read may be noise before the true reply (R7)."""
        transaction = self._transaction
        assert transaction is not None
        transaction.last_byte = now
        self._end_exchange()
        self.dispatcher.refused(transaction, refusal, now)
        if transaction.writes:
            self._release(now, self._leg.timing.turnaround, now)
        else:
            self._settle(now)

    def _say(self, send: bytes, now: float) -> float:
        """Send what closes an exchange; returns when it is out."""
        self._out += send
        self._echo.sent(send)
        self._leg.end = now + len(send) * self.byte_time
        return self._leg.end

    def _end_exchange(self, failed: bool = False) -> None:
        if failed and self._exchange is not None:
            self._leg.give_up(self._exchange.later)
        self._transaction = None
        self._exchange = None
        self._counters.exchanges += 1

    # the line between exchanges

    def _release(self, free: float, hold: float, now: float) -> None:
        """The outcome was certain: the next request may follow `hold` seconds behind our own last byte."""
        if self._closed:
            self._go_offline(now)
        elif hold or not self._advance(now, free):
            held = free + hold > now
            self._enter(HOLDOFF if held else READY, now)
            self._deadlines.line = free + hold if held else inf

    def _settle(self, now: float) -> None:
        """Discard until it has been silent long enough and nothing can come any more (R3)."""
        if self._closed:
            self._go_offline(now)
            return
        if self.state is not SETTLING:
            self._counters.settles += 1
            self._enter(SETTLING, now)
        self._echo.forget()
        silent = self._strays.last_byte + self._leg.quiet()
        self._deadlines.line = max(self._leg.past(), silent, self._quarantine, now)

    def _free(self, now: float) -> None:
        """A holdoff or a settle is over."""
        if self.state is SETTLING:
            self._strays.silent()
            if self._answer_stray(self._strays.reply_to_silence(), now):
                return
            if self.noisy:
                self.noisy = False
                self.dispatcher.fault = None
                self._events.append(LineChanged(LineChange.QUIET))
        self._enter(READY, now)
        self._deadlines.line = inf
        self._advance(now)

    def _stray(self, data: bytes, now: float) -> None:
        """Bytes that nobody asked for."""
        strays = self._strays
        strays.note(data, now, self._leg.quiet())
        self._leg.strayed(now)
        if self.state is OFFLINE:
            return
        self._settle(now)
        if not self.noisy:
            self._answer_stray(strays.reply_to(data), now)
        if strays.babbling(now) and not self.noisy:
            self.noisy = True
            self._counters.noisy += 1
            self._events.append(LineChanged(LineChange.NOISY))
            self.dispatcher.fault = lambda: LineNoisy("the line has not been silent for a second")
            self.dispatcher.fail_all(now)

    def _answer_stray(self, send: bytes, now: float) -> bool:
        """True if an answer was owed: then the line settles again."""
        if send:
            self._say(send, now)
            self._settle(now)
        return bool(send)

    def _strip_echo(self, data: bytes, now: float) -> bytes:
        """Take the echo of what was sent off the front, byte for byte; a mismatch is a collision."""
        rest = self._echo.strip(data)
        if rest is None:
            self._counters.collisions += 1
            self._events.append(Strayed(data, collision=True))
            self._strays.last_byte = now
            if self.state is EXCHANGE:
                what = "the echo differs from what was sent: a collision, or an adapter without echo"
                self._attempt_failed(FrameError(what), now)
            else:
                self._settle(now)
            return b""
        if not self._echo.owed and self.state is EXCHANGE and not self._leg.begun:
            due = self._leg.echoed(now)
            answered = self._exchange is not None and self._exchange.answered
            self._deadlines.line = due if answered else now + self._leg.timing.turnaround
        return rest

    def _go_offline(self, now: float) -> None:
        """Whatever is on the wire is cut off."""
        transaction = self._transaction
        self._enter(OFFLINE, now)
        self.noisy = False
        self._deadlines.line = inf
        self._out = b"" if transaction is not None else self._out
        self._echo.forget()
        self._strays.answered()
        self._strays.silent()
        if transaction is not None:
            self._end_exchange(failed=True)
            self.dispatcher.cut_off(transaction, self._offline(), now)

    def _enter(self, state: LineState, now: float) -> None:
        spent = self._counters.spend(self.state, now)
        if self.state is READY:
            self.dispatcher.idle(spent)
        self.state = state

    def _offline(self) -> BusError:
        return LineDown(f"the line is down: {self._cause}")
