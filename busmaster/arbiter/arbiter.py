"""The state machine of one line.

The line is half-duplex, has many nodes, and replies are anonymous. At most one exchange is on the line (R1). No byte of
an earlier exchange can arrive when the next one begins (R3), unless its window was learned (R15). The arbiter does no
I/O and reads no clock: the caller passes the time and the received bytes, then calls `poll_transmit`, then
`poll_event`, and sets a timer for `poll_timeout`. A call that is too early changes nothing.

The line is in one of five states. `_deadlines.line` is the time at which the state ends without further input.

===============  =====================  ========================  =======================  =====================
state            data received          its deadline              line_up / line_down      submit, poll due
===============  =====================  ========================  =======================  =====================
OFFLINE          counted, dropped       never                     up: RESYNCHRONISING      fails with LineDown
READY            unexpected:            never                     down: OFFLINE            EXCHANGE
                 RESYNCHRONISING
HOLDOFF          unexpected:            READY                     down: OFFLINE, all fail  waits
                 RESYNCHRONISING
EXCHANGE         read: stays, or ends   window is over: stays     down: OFFLINE, all fail  waits
                 in READY, HOLDOFF or   until the maximum reply
                 RESYNCHRONISING        delay is; then, or gap
                                        is over: failed
                                        (RESYNCHRONISING), next
                                        step, or done (broadcast)
RESYNCHRONISING  unexpected: silence    READY                     down: OFFLINE, all fail  waits (NOISY: fails)
                 again; 1 s of it:
                 NOISY, all fail
===============  =====================  ========================  =======================  =====================

The line never stays in READY while a request is queued: each transition to READY starts the next transaction in the
same call. An exchange ends in READY or HOLDOFF only if its outcome is certain: a matching reply with no further bytes,
or a NAK to a write. After every other outcome the line resynchronises: it waits for silence and for the maximum reply
delay (on_wire.py).

Reply times start when the bytes have left the port. `poll_transmit` hands the bytes over. `transmitted` reports when
the port has taken them. `unsent` reports, when a deadline of the line expires, how many bytes have not left yet. Until
they have left, no deadline expires.

choice.py selects the next request, depending on the overdue replies (in_sync.py). dispatcher.py handles failed
attempts.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from math import inf
from typing import Any

from busmaster.arbiter.choice import Choice, Idle, WaitUntil
from busmaster.arbiter.clients import OWN, Hold, LineClient
from busmaster.arbiter.counters import (
    EXCHANGE,
    HOLDOFF,
    OFFLINE,
    READY,
    RESYNCHRONISING,
    LineCounters,
    LineState,
    LineStatistics,
    Mark,
)
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.dispatcher import Dispatcher, Tapped
from busmaster.arbiter.events import CameUnexpected, Event, LineChange, LineChanged
from busmaster.arbiter.health import DOWN, NodeRecord
from busmaster.arbiter.in_sync import InSync
from busmaster.arbiter.learned import Learning
from busmaster.arbiter.on_wire import UNKNOWN_MAX_REPLY_DELAY, Echo, OnWire, Step
from busmaster.arbiter.transaction import HELD, Poll, Transaction
from busmaster.arbiter.trust import COLLIDED, TOO_EARLY, TWO_ANSWERS, Trust, damaged
from busmaster.arbiter.unexpected import LOOK_SLACK, QUIET, UnexpectedBytes
from busmaster.contract.exchange import NO_REPLY, Done, Expect, FrameError
from busmaster.contract.learning import Learned, documented
from busmaster.contract.profile import Profile
from busmaster.contract.tap import Attempt
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import BusClosed, BusError, LineDown, LineNoisy, Refused


class Arbiter:
    """The arbiter of one line: its states and the operations of its caller.

    `byte_time`: tau, in seconds per byte. `echo`: the port receives its own transmissions. `receive_latency`: seconds
    for which an adapter can hold received bytes. `capacity`: maximum number of queued requests per class. `jitter`:
    returns numbers from 0 to 1, used to spread probes. `strict`: hold every ambiguous reply until the other possible
    reply would have arrived (R15).
    """

    name = ""
    """Name of the line, used in error messages."""
    longest_hold = 0.0
    """Longest `max_hold` of any exclusive sequence so far, in seconds."""

    def __init__(
        self,
        byte_time: float,
        *,
        now: float = 0.0,
        echo: bool = False,
        receive_latency: float = 0.0,
        capacity: int = 1000,
        jitter: Callable[[], float] = lambda: 0.5,
        strict: bool = False,
    ) -> None:
        self.state = OFFLINE
        self.noisy = False
        self._echo = Echo(echo)
        self._deadlines = Deadlines()
        self._counters = LineCounters(now)
        self.dispatcher = Dispatcher(self._deadlines, self._counters, now, capacity, jitter)
        self.dispatcher.fault = self._offline
        self.events = self.dispatcher.events
        self._cause = "not open yet"
        self._hint: str | None = None
        self._closed = False
        # the exchange on the wire
        self._step = Step(ReplyTiming(0.0, 0.0, UNKNOWN_MAX_REPLY_DELAY, QUIET), receive_latency, byte_time)
        self._in_sync = InSync(strict)
        dispatcher = self.dispatcher
        self._wire = OnWire(
            self._step, self._echo, self._deadlines, self._in_sync, dispatcher.urgent_waits, dispatcher.is_wanted
        )
        self.dispatcher.is_held = lambda: self._wire.output.held
        self._choice = Choice(self.dispatcher, self._in_sync, self._wire)
        self._trust = Trust(self._in_sync)
        # the line
        self._unexpected = UnexpectedBytes(self.events, self._counters)
        self._up_at = self._quarantine = self._silent_at = -inf

    # inputs

    def line_up(self, now: float, *, paced: bool = False) -> None:
        """Handle an opened port. Resynchronises first, because replies to an earlier master may still arrive.

        If `paced`, bytes leave at the baud rate, so bytes that arrive too early cannot be a reply (R4).
        """
        if self.state is not OFFLINE or self._closed:
            return
        self._step.paced = paced and not self._echo.declared
        self.dispatcher.fault = None
        self.events.append(LineChanged(LineChange.UP))
        max_reply_delay = max((node.max_reply_delay for node in self.dispatcher.nodes), default=UNKNOWN_MAX_REPLY_DELAY)
        self._up_at = now
        self._quarantine = now + max_reply_delay + self._step.latency + self._step.byte_time
        # A node may hold half a frame of an earlier master, and answer the next frame on the line, whichever node it is
        # for (R15).
        self._in_sync.came_up()
        self._resynchronise(now)

    def line_down(self, cause: str, now: float) -> None:
        """Handle a lost port: fail all requests, including the queued ones (R13)."""
        # A port that fails while it is being closed reports its loss twice.
        if self.state is OFFLINE:
            return
        self._counters.losses += 1
        self._cause, self._hint = cause, None
        self.events.append(LineChanged(LineChange.DOWN, cause))
        if not self._closed:
            self.dispatcher.fault = self._offline
        self._go_offline(now)
        self.dispatcher.fail_all(now)

    def still_down(self, cause: str, hint: str) -> None:
        """Store why the port cannot be reopened. Requests that fail report this cause instead of the original loss."""
        # The old cause ("it hung up") does not help later: "no permission" or "in use by PID 812" does.
        self._cause, self._hint = cause, hint

    def data_received(self, data: bytes, now: float) -> None:
        """Process received bytes: an echo, a reply, or unexpected bytes."""
        # The echo first: on an echoing port the first bytes received are always our own.
        if self._echo.pending:
            data = self._strip_echo(data, now)
            if not data:
                return
        self._step.heard = True
        if self.state is not EXCHANGE:
            self._take_unexpected(data, now)
        # A second reply while one is held: it is not known which of them is right, so neither is delivered.
        elif self._trust.held is not None:
            self._disbelieve(TWO_ANSWERS, Done(None, data, self._trust.held.send), now)
        elif self._step.begun:
            self._unexpected.last_byte = now
            self._take(data, now)
        else:
            self._begin_reply(data, now)

    def byte_marked(self, mark: Mark, now: float) -> None:
        """Handle a UART report of a break or a damaged byte. The byte is not accepted as part of any reply."""
        # The byte may have been any part of the reply, or the echo. A UART mark is more reliable than a checksum: a
        # single exclusive-or byte misses some double errors, and only parity distinguishes a damaged ACK from Mentor
        # II's EOT (docs/proof.md, 5).
        self._counters.mark(mark)
        self._unexpected.last_byte = now
        self._step.heard = True
        self._echo.forget()
        if self.state is EXCHANGE:
            self._step.begun = True
            self._attempt_failed(FrameError(damaged(mark)), now)
        else:
            self._take_unexpected(b"\0", now)

    def transmitted(self, now: float) -> None:
        """Shift the reply times if the port took the bytes later than `poll_transmit` handed them over.

        The process may have been suspended in between. The clock is read after the write (R2).
        """
        output = self._wire.output
        sent_at = output.sent_at
        late = now - sent_at
        if late > 0.0:
            output.sent_at = now
            step = self._step  # Same as `step.shift`, written out: this runs for every request.
            step.end += late
            step.out += late
            if step.paced:
                step.taint_until += late
            self._deadlines.line += late
            if self.state is RESYNCHRONISING:
                self._silent_at += late
            # Not for an ACK within the exchange: its request left earlier, and the overdue reply can be as old as that
            # request.
            if late > LOOK_SLACK and output.begins:
                asked = self._wire.transaction
                if asked is not None and asked.started == sent_at:
                    asked.started = now

    def line_due(self, now: float) -> bool:
        """Return True if a deadline of the line has expired. If the port can report unsent bytes, call `unsent`
        first."""
        return now >= self._deadlines.line

    def unsent(self, count: int, now: float) -> None:
        """Report how many handed-over bytes have not left the port.

        Until all have left, no deadline expires, no further request is sent, and received bytes are not accepted as the
        reply. The caller must report the count again before it passes received bytes. A line that is being closed does
        not wait for unsent bytes; they are only mentioned in the error.
        """
        # A request held for less than its window and released before the first query is not noticed: its window then
        # counts from the write (docs/proof.md, 6). R15 keeps its late reply from being delivered.
        again = self._wire.output.unsent(count, now)
        # Closing does not wait: flow control can hold the bytes for ever, and `close` must end (R8).
        if again is not None and (again == inf or not self._closed):
            self._deadlines.line = self._due_anew(now) if again == inf else again

    def _due_anew(self, now: float) -> float:
        """Return the deadline of the line, counted from the end of bytes that have just left."""
        if self.state is EXCHANGE:
            return self._wire.due_anew(now)
        if self.state is RESYNCHRONISING:
            self._resynchronise(now)
            return self._deadlines.line
        return now + self._step.timing.driver_release_time if self.state is HOLDOFF else inf

    def handle_timeout(self, now: float, *, unread: bool = False) -> None:
        """Run the timers that have expired. `unread`: received bytes were not passed on yet, so silence is not
        known."""
        deadlines = self._deadlines
        if now >= deadlines.earliest_other:
            self.dispatcher.handle_timeout(now, unread)
            if now >= deadlines.health:
                self._enter(self.state, now)
                self.dispatcher.probe(now, self.state is READY)
        # While input is unread, the line timer does not run: after the loop was blocked, a reply that arrived in time
        # would otherwise count as missing (tests/transport/test_blocked_loop.py).
        if now >= deadlines.line and not unread:
            if self.state is EXCHANGE:
                if self._trust.held is not None:
                    self._complete(self._trust.held, now)
                elif not self._awaits_late_reply(now):
                    self._take(None, now)
            elif self.state is RESYNCHRONISING and now < self._silent_at:
                deadlines.line = self._unexpected.look_before(self._silent_at, now)
            else:
                self._free(now)
        elif self.state is READY:
            self._advance(now)

    # one exchange

    def _advance(self, now: float) -> bool:
        """Start the next transaction, directly behind the last transmitted byte. Returns False if none is queued."""
        # Nothing is sent while the reply to an earlier master, or an overdue reply that was waited for, can still
        # begin.
        if now < self._quarantine:
            self._resynchronise(now)
            return True
        unexpected = self._unexpected
        action = self._choice.next(now, unexpected.last_byte)
        if type(action) is Idle:
            return False
        if type(action) is WaitUntil:
            self._quarantine = action.time
            self._resynchronise(now, begun=True)
            return True
        transaction, exchange = action
        self.dispatcher.started(transaction, now)
        if self.state is not EXCHANGE:
            self._enter(EXCHANGE, now)
        self._wire.begin(transaction, exchange, now)
        if unexpected.unanswered_one is not None:
            unexpected.looked(now, self._deadlines.line)
        return True

    def _begin_reply(self, data: bytes, now: float) -> None:
        """Process the first bytes received in a step. Bytes that can belong to the reply start it."""
        wire, step = self._wire, self._step
        transaction = wire.transaction
        assert transaction is not None
        # R4: bytes that arrive before 90 % of the request is on the wire, or while the port still holds part of it,
        # cannot be its reply.
        # They are noise, or the reply to an earlier request that is later than its maximum reply delay.
        if now < step.taint_until or wire.output.held:
            self._counters.tainted += 1
            self._unexpected.last_byte = now
            self._attempt_failed(FrameError(TOO_EARLY, heard=data), now)
            return
        if not wire.answered:
            self._unexpected.note(data, now, step.quiet())
            # A broadcast has no reply, so these bytes fail nothing. They are unexpected, and the line resynchronises
            # when it has left.
            wire.came_unexpected = True
            return
        if transaction.node.profile.noise_tolerant:
            # Only bytes with which no reply of this exchange can begin are noise.
            heard, data = data, wire.without_noise(data)
            self._counters.noise_bytes += len(heard) - len(data)
            if not data:
                self._unexpected.last_byte = now  # noise that is skipped still interrupts the silence
                return
        step.begun = True
        step.begun_at = now
        # Their number is needed to learn reply times: an adapter with a latency timer delivers a whole reply at once.
        step.first_bytes = data
        if transaction.first_byte == -inf:
            transaction.first_byte = now
        # Both count from the end of the request, and allow for the time in the adapter: a slow adapter does not make a
        # node late.
        if now > step.end + step.timing.late_after + step.latency:
            transaction.late = True
            if now > step.end + step.timing.window + step.latency:
                transaction.overdue = True
        self._unexpected.last_byte = now
        self._take(data, now)

    def _take(self, data: bytes | None, now: float) -> None:
        """Pass bytes to the protocol's reader, or None if the deadline expired, and act on its result."""
        no_reply = data is None and not self._step.begun
        try:
            exchange = self._wire.exchange
            assert exchange is not None
            progress = exchange.expired(self._step.begun) if data is None else exchange.feed(data)
            if type(progress) is Expect:
                self._watch_max_reply_delay()  # before `follow`: the next step overwrites this one's times
                progress = self._wire.follow(progress, now)
        except FrameError as error:
            self._attempt_failed(error, now, no_reply=no_reply)
        except Refused as refusal:
            self._refused(refusal, now)
        # A bug in one protocol must not stop the line for all other nodes. The request fails with it.
        except Exception as bug:
            self._attempt_failed(FrameError(f"a bug in the protocol's reader: {bug!r}"), now, bug=bug)
        else:
            if type(progress) is Done:
                self._complete(progress, now)
            elif self._step.begun:
                self._deadlines.line = self._wire.gap_over(now)

    def _awaits_late_reply(self, now: float) -> bool:
        """Continue to wait for a reply that has not begun within its window. Returns True if it can still begin.

        The line would resynchronise until then anyway (R3), so waiting for a late correct reply costs no line time. A
        learned window ends the wait: the line continues, and the reply becomes overdue (R15).
        """
        wire, step, unexpected = self._wire, self._step, self._unexpected
        if step.begun or not wire.answered or step.timing.silence is not None:
            return False
        # Closing waits for the window only (R8). If an echo was lost, the reply cannot be separated from it.
        if self._closed or self._echo.pending:
            return False
        # R2: no reply can begin after the maximum reply delay, so no caller waits longer for one.
        until = step.last_begin()
        if now >= until:
            return False
        # From here on the line is read every tenth of a maximum reply delay: the age of a late reply must be known
        # exactly, because it may raise that delay.
        assert wire.transaction is not None
        unexpected.unanswered(wire.transaction.node, step.end, step.timing.max_reply_delay)
        self._deadlines.line = unexpected.look_before(until, now)
        return True

    def _watch_max_reply_delay(self) -> None:
        """Report a reply that began after its window, and raise the node's maximum reply delay if it was close to it
        (R3)."""
        step, transaction = self._step, self._wire.transaction
        assert transaction is not None
        # `overdue` may have been set by an earlier step of the exchange
        if transaction.overdue and step.begun and step.begun_at > step.end + step.timing.window + step.latency:
            self._unexpected.note_late(transaction.node, step.timing, step.end, step.begun_at)

    def _complete(self, progress: Done[Any], now: float) -> None:
        """Deliver a value. The line is free when the closing ACK has left and the node has released the line."""
        wire, step = self._wire, self._step
        transaction, exchange = wire.transaction, wire.exchange
        assert transaction is not None
        assert exchange is not None
        answered, rest = wire.answered, progress.rest
        alert = self._in_sync.alert
        # The first frame on a new line has left: from now on it is known until when a NAK or an ACK may be for an
        # earlier master.
        if alert and self._in_sync.lone_bytes_until == inf:
            self._first_frame_ended()
        if answered:
            # The usual reply needs no check: nothing is overdue and no byte follows. This comparison is all that R15
            # costs then.
            if alert or rest:
                verdict = self._trust.weigh(wire, progress, now)
                if isinstance(verdict, str):
                    # An ambiguous reply does not prove that the request has left, so the times below stay unchanged.
                    self._disbelieve(verdict, progress, now)
                    return
                if verdict is not None:
                    self._deadlines.line = verdict
                    return
            begun_at = step.begun_at
            if transaction.overdue:  # checked here as well, to save a call: this runs for every reply
                self._watch_max_reply_delay()
            # Unpaced port: a request that was answered has left, even if the configured baud rate is lower than the
            # real one.
            # The proof found the opposite error too: an ambiguous reply that moved these times let the next request
            # leave 11.8 ms too early (docs/proof.md, 1).
            if step.end > begun_at:
                step.end = step.out = begun_at
            transaction.node.note_reply(exchange.answers, transaction.command, begun_at - step.end)
            if transaction.node.learning is not None:
                wire.learn(now)
        # MSC: the packet is acknowledged before its caller is notified, because the unit repeats it until then.
        if progress.send:
            wire.send(progress.send, now)
        wire.transaction = wire.exchange = None  # `trust.held` is None here: a held reply has been evaluated again
        self._counters.exchanges += 1
        self.dispatcher.succeeded(transaction, progress.value, now)
        # the echo of a broadcast may never arrive
        if rest or wire.came_unexpected or (self._echo.pending and not answered):
            if rest:
                self._unexpected.note(rest, now, step.quiet())
            self._resynchronise(now)
            return
        self._unexpected.unanswered_one = None
        self._release(step.timing.driver_release_time if answered else 0.0, now)

    def _disbelieve(self, what: str, progress: Done[Any], now: float) -> None:
        self._counters.ambiguous += 1
        if self._wire.transaction is not None:
            # The node is alive although its reply is not delivered: a sync read can clear its overdue reply.
            self._wire.transaction.node.unheard = 0
        if progress.rest:
            self._unexpected.note(progress.rest, now, self._step.quiet())
        self._attempt_failed(FrameError(what, send=progress.send), now, ambiguous=True)

    def _attempt_failed(
        self,
        error: FrameError,
        now: float,
        no_reply: bool = False,
        ambiguous: bool = False,
        bug: Exception | None = None,
    ) -> None:
        transaction, step, unexpected = self._wire.transaction, self._step, self._unexpected
        assert transaction is not None
        if no_reply and self._wire.output.held:
            error.what, error.hint = "the port had not sent it when the bus was closed", HELD
        # The next bytes may be its reply, however late. `unanswered` stores its age, so that the node's delay can be
        # raised.
        elif no_reply:
            unexpected.unanswered(transaction.node, step.end, step.timing.max_reply_delay)
            if error.what == NO_REPLY:
                timing = step.timing
                # same conditions as in _awaits_late_reply
                early = timing.silence is not None or self._closed or self._echo.pending
                awaited = timing.window if early else timing.max_reply_delay
                error.what = f"no reply within {awaited * 1000:g} ms"
            if self._echo.pending:
                error.what += ", and no echo of the request: if the adapter has none, leave echo out"
        else:
            if transaction.overdue:
                # Late and wrong bytes may be noise, so they do not raise the maximum reply delay.
                unexpected.answered()
            # For example an ACK from noise in place of the ACK: the overdue reply may be among these bytes.
            if error.heard:
                unexpected.came(now)
                unexpected.run[:] = error.heard
        # The reply was complete (bad checksum), so only silence is awaited and not the maximum reply delay (R3).
        spared = error.whole and not self._in_sync.is_overdue(now)
        # Two replies to one request: a node replies twice, or an overdue reply came first. Neither is delivered, and
        # for the next 30 s ambiguous replies are held.
        both = error.what is TWO_ANSWERS
        if both:
            self._in_sync.answered_twice(now)
        self._trust.add_overdue(self._wire, heard=not no_reply, whole=error.whole or both)
        if error.send:
            self._wire.send(error.send, now)
        self._end_exchange()
        if bug is None:
            self.dispatcher.attempt_failed(transaction, no_reply, error, now, ambiguous)
        else:
            self.dispatcher.broken(transaction, bug, now)
        self._resynchronise(now, begun=spared)

    def _refused(self, refusal: Refused, now: float) -> None:
        """Handle a refusal. A NAK to a write is certain; a NAK to a read may be noise before the true reply (R7).

        While a reply is overdue, no refusal is certain, because it may belong to an earlier request (R15).
        """
        transaction = self._wire.transaction
        assert transaction is not None
        # A NAK is one byte, the same for all nodes: while any reply is overdue, it can be the reply to another request.
        certain = not self._in_sync.refusals_are_ambiguous(now)
        if not certain:
            self._trust.add_overdue(self._wire, heard=False)
        elif transaction.writes:
            self._watch_max_reply_delay()
        # The second refusal of a read in a row cannot be noise: only silence is awaited, and not the maximum reply
        # delay.
        confirmed = transaction.refusals > 0
        transaction.last_byte = now
        self._end_exchange()
        self.dispatcher.refused(transaction, refusal, certain, now)
        if transaction.writes and certain:
            self._step.answered()  # a refused request has left the port, like an answered one
            self._release(self._step.timing.driver_release_time, now)
        else:
            self._resynchronise(now, begun=confirmed and certain)

    def _first_frame_ended(self) -> None:
        """Set the time after which no node can still reply to the first frame (R15)."""
        max_reply_delay = max((node.max_reply_delay for node in self.dispatcher.nodes), default=UNKNOWN_MAX_REPLY_DELAY)
        self._in_sync.lone_bytes_until = self._step.out + max_reply_delay + self._step.latency + self._step.byte_time

    def _end_exchange(self) -> None:
        wire = self._wire
        if self._in_sync.lone_bytes_until == inf:
            self._first_frame_ended()
        if wire.exchange is not None:
            # The order matters: `came_unexpected` extends only what `give_up` has noted.
            self._step.give_up(wire.exchange.later)
            # MSC: the bytes may have been the ACK, damaged. Its packet then begins up to its own maximum reply delay
            # later: the proof found it half a second inside the next exchange (docs/proof.md, 2).
            self._step.came_unexpected(self._unexpected.last_byte)
        wire.transaction = wire.exchange = self._trust.held = None
        self._counters.exchanges += 1

    # the line between exchanges

    def _release(self, hold: float, now: float) -> None:
        """Allow the next request `hold` seconds after the last transmitted byte. The outcome was certain."""
        if self._closed:
            self._go_offline(now)
        # The request follows the closing ACK in the same write: a wait for the ACK would need a timer.
        elif hold or not self._advance(now):
            free = hold + (self._step.out if self._step.out > now else now)  # a call of `max` takes three times as long
            self._enter(HOLDOFF if free > now else READY, now)
            self._deadlines.line = free if free > now else inf

    def _resynchronise(self, now: float, begun: bool = False) -> None:
        """Discard input until the line is silent and the maximum reply delay has passed (R3).

        If the reply has `begun`, only the silence is required.
        """
        if self._closed:
            self._go_offline(now)
            return
        if self.state is not RESYNCHRONISING:
            self._counters.resyncs += 1
            self._enter(RESYNCHRONISING, now)
        self._echo.forget()
        # R3's first condition. A silence alone proves nothing: a drive that replies after 40 ms is silent until then.
        silent = max(self._step.silent_at(self._unexpected.last_byte), self._quarantine, now)
        # After a learned window the line continues: the reply that may still arrive is tracked as overdue (R15).
        goes_on = begun or self._step.timing.silence is not None
        self._silent_at = silent if goes_on else max(silent, self._step.past())
        self._deadlines.line = self._unexpected.look_before(self._silent_at, now)

    def _free(self, now: float) -> None:
        """End a holdoff or a resynchronisation."""
        if self.state is RESYNCHRONISING:
            # This order: bytes that were just received may clear an overdue reply, and only then may the next request
            # be chosen.
            self._step.resynchronised()
            self._hear_out(self._unexpected.silent(), now)
            if self._answer_unexpected(self._unexpected.reply_to_silence(), now):
                return
            if self.noisy:
                self.noisy = False
                self.dispatcher.fault = None
                self.events.append(LineChanged(LineChange.QUIET))
        self._enter(READY, now)
        self._deadlines.line = self._unexpected.look_before(inf, now)
        self._advance(now)

    def _take_unexpected(self, data: bytes, now: float) -> None:
        """Process bytes that belong to no request."""
        unexpected = self._unexpected
        unexpected.note(data, now, self._step.quiet())
        self._step.came_unexpected(now)
        if self.state is OFFLINE:
            return
        self._resynchronise(now)
        self._answer_unexpected(unexpected.reply_to(data, self.noisy), now)
        # Failing is better than waiting: a node that transmits without a pause blocks the line until it is replaced. No
        # request could meet its deadline.
        if unexpected.babbling(now) and not self.noisy:
            self.noisy = True
            self._counters.noisy += 1
            self.events.append(LineChanged(LineChange.NOISY))
            self.dispatcher.fault = lambda: LineNoisy("the line has not been silent for a second")
            self.dispatcher.fail_all(now)

    def _hear_out(self, run: bytes, now: float) -> None:
        """Process the bytes received before this silence. A node whose overdue reply is found is alive (R11, R15)."""
        node = self._trust.hear(self._wire, run, self._unexpected, now, self._echo.astray) if run else None
        # It has transmitted, so its next probe is sent at once instead of after up to 30 s.
        if node is not None and node.health is DOWN:
            self.dispatcher.probes.alive(node, now)

    def _answer_unexpected(self, send: bytes, now: float) -> bool:
        """Send an acknowledgement for an unexpected packet (MSC). Returns True if `send` is not empty; then the line
        resynchronises."""
        if send:
            self._wire.send(send, now)
            # `_resynchronise` below forgets pending echoes.
            overdue = self._echo.pending
            self._resynchronise(now)
            self._echo.pending = overdue  # the resynchronisation cleared it, but these bytes are echoed too
        return bool(send)

    def _strip_echo(self, data: bytes, now: float) -> bytes:
        """Remove the echo of sent bytes from the input, byte by byte. A mismatch is a collision."""
        rest = self._echo.strip(data)
        self._unexpected.last_byte = now  # if the echo was lost, these bytes may be another node's that look like it
        if self.state is RESYNCHRONISING:  # an ACK may precede its packet (MSC)
            self._silent_at = max(self._silent_at, self._step.came_unexpected(now))
        # Another master, or a node that replies to an earlier request: both corrupt the request, so no reply to it can
        # be trusted.
        if rest is None:
            self._step.heard = True
            self._counters.collisions += 1
            self.events.append(CameUnexpected(data, collision=True))
            if self.state is EXCHANGE:
                self._attempt_failed(FrameError(COLLIDED), now)
            else:
                self._resynchronise(now)
            return b""
        if not self._echo.pending and self.state is EXCHANGE and not self._step.begun:
            self._wire.output.held = False  # the echo has arrived, so the request has left
            due = self._step.echoed(now)
            self._deadlines.line = due if self._wire.answered else now + self._step.timing.driver_release_time
        return rest

    def _go_offline(self, now: float) -> None:
        """Abort the exchange on the wire and enter OFFLINE."""
        transaction = self._wire.transaction
        self._enter(OFFLINE, now)
        self.noisy = False
        self._deadlines.line = inf
        self._echo.forget()
        self._unexpected.forget()
        if transaction is not None:
            self._wire.output.discard()
            # The node may still reply after the port is open again: a lost port clears nothing (R15).
            self._trust.add_overdue(self._wire, heard=True)
            self._end_exchange()
            self.dispatcher.cut_off(transaction, self._offline(), now)

    def _enter(self, state: LineState, now: float) -> None:
        counters, before = self._counters, self.state
        spent = now - counters.entered
        counters.spent[before] += spent
        counters.entered = now
        # Idle time pays for probes of dead nodes (R11).
        if before is READY:
            self.dispatcher.probes.budget.idle(spent, state is not READY)
        self.state = state

    def _offline(self) -> BusError:
        return LineDown(f"the line is down: {self._cause}", hint=self._hint)

    # called by the owner

    @property
    def byte_time(self) -> float:
        """tau: seconds per byte of this line."""
        return self._step.byte_time

    @byte_time.setter
    def byte_time(self, seconds: float) -> None:
        self._step.byte_time = seconds

    @property
    def attempt(self) -> Attempt | None:
        """The attempt on the wire, if the line is tapped."""
        tapped = self.dispatcher.tapped
        return None if tapped is None else tapped.attempt

    def set_tapped(self, tapped: bool) -> None:
        """Turn the tap on or off. While it is on, `attempt` is set and the end of each attempt is an event."""
        self.dispatcher.tapped = Tapped(self.events, self._counters) if tapped else None

    def add_node(
        self,
        profile: Profile,
        address: int,
        now: float,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> NodeRecord:
        """Add a node and return its record.

        Raises InvalidCommand if the protocol does not have this address, or if learned windows are requested and the
        protocol does not support them (HCP).
        """
        profile.check_address(address)
        if isinstance(timings, Learned):
            profile.check_learnable()
        node = NodeRecord(
            profile,
            address,
            documented(timings) or profile.timings,
            profile.retries if retries is None else retries,
            self.name,
        )
        if isinstance(timings, Learned):
            # Learned windows are safe only by R15, which a protocol must support: HCP's read request has no checksum,
            # so a corrupted request can be answered.
            node.learning = Learning()
        self.dispatcher.nodes.append(node)
        # One listener per line: only one protocol of a line acknowledges packets that were not requested (MSC).
        if profile.listen is not None and self._unexpected.listener is None:
            self._unexpected.listener = profile.listen()
        # R3: an earlier master may have sent this node a request just before the port was opened. Wait for that reply.
        self._quarantine = max(
            self._quarantine, self._up_at + node.max_reply_delay + self._step.latency + self.byte_time
        )
        return node

    def remove_node(self, node: NodeRecord) -> None:
        """Remove a node. The line sends it no further probe or sync read.

        An exchange with the node that is on the wire is finished. Its overdue replies stay overdue (R15). Another
        node's reply clears them, as for a silent node.
        """
        # The record is still referenced by overdue replies and by statistics that callers hold.
        node.removed = True
        self.dispatcher.nodes.remove(node)
        self.dispatcher.writes.forget_empty()
        self.dispatcher.probes.plan()

    def ask_within_budget(self, node: NodeRecord, now: float) -> None:
        """Treat a new node as DOWN until its first reply, so that requests to it use only the probe budget (R11)."""
        # A client may name any address. Each absent one would cost a maximum reply delay at normal priority.
        node.health, node.budgeted, node.probe_at = DOWN, True, now
        self.dispatcher.probes.plan()

    def name_node(self, node: NodeRecord, label: str) -> None:
        """Set the label of a node, used in messages."""
        node.label = label

    def change_profile(self, node: NodeRecord, profile: Profile) -> None:
        """Replace a node's profile by another one of the same protocol, for example one that merges reads
        differently."""
        node.profile = profile

    def expect_hook(self, node: NodeRecord, expected: bool) -> None:
        """Enable or disable holding the polls of a returning node until `Dispatcher.release_node`."""
        node.has_hook = expected

    def note_stop(self, node: NodeRecord) -> None:
        """Count a stop command to this node."""
        node.stops += 1

    def answer_counts(self, now: float) -> bool:
        """Return True if a caller's deadline has passed during an exchange. The owner must pass on received bytes
        first."""
        # A loop that was blocked may run its timers before it reads. Bytes that lie unread arrived in time.
        return self.state is EXCHANGE and now >= self._deadlines.expiry

    def add_client(self, share: float = 1.0, owner_time: float = 0.0, user: Hashable = None) -> LineClient:
        """Add a client that takes turns with the line's owner and with the other clients (R9)."""
        client = LineClient(share, user=user)
        self.dispatcher.share().admit(client, owner_time)
        return client

    def change_client(self, client: LineClient, owner_time: float) -> None:
        """Set a client's `owner_time`, after its role has changed."""
        self.dispatcher.share().admit(client, owner_time)

    def remove_client(self, client: LineClient) -> None:
        """Remove a client that has no queued requests. Its exchange on the wire, if any, is finished."""
        # A retry of its request on the wire would be sent for a program that is gone.
        client.over = True
        self.dispatcher.share().forget(client)

    def exclusive(self, node: NodeRecord, client: LineClient | None, longest: float) -> Hold:
        """Return a `Hold` that the requests of one sequence use as their client. End it with `release`."""
        self.dispatcher.share()
        self.longest_hold = max(self.longest_hold, longest)
        return Hold(node, OWN if client is None else client, longest)

    def release(self, hold: Hold, now: float) -> None:
        """End a sequence. Its unsent requests fail with HoldEnded, and the line is free for other clients."""
        if not hold.over:
            self.dispatcher.end_hold(now, hold)
        if self.state is READY:
            self._advance(now)

    def submit(self, transaction: Transaction, now: float) -> bool:
        """Queue a transaction, or end it immediately.

        Returns False if it was queued and nothing else changed: there is no output or event to fetch.
        """
        changed = self.dispatcher.submit(transaction, now)
        if self.state is READY:
            self._advance(now)
            return True
        return changed

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Cancel a transaction. Takes effect immediately and does not touch the line (R6)."""
        self.dispatcher.cancel(transaction, now)

    def supersede_writes(self, now: float) -> None:
        """Fail all queued writes with Superseded, before the safe state is sent."""
        self.dispatcher.supersede_writes(now)

    def add_poll(self, poll: Poll, now: float) -> None:
        """Start a poll. Its first cycle waits until a line that has just been opened is usable."""
        # Otherwise the first cycles of all groups would count as late on each start.
        self.dispatcher.add_poll(poll, max(now, self._quarantine))

    def remove_poll(self, poll: Poll, now: float) -> None:
        """Remove a poll. Its queued requests are discarded; the reply of one on the wire is ignored."""
        self.dispatcher.remove_poll(poll, now)

    def demand(self, poll: Poll, now: float) -> None:
        """Run one cycle of a poll now, outside its grid."""
        self.dispatcher.demand(poll, now)
        if self.state is READY:
            self._advance(now)

    def close(self, now: float) -> None:
        """Fail all queued requests with BusClosed. After the exchange on the wire has finished, the line is OFFLINE.

        `failing` is True while some of these requests have not ended yet.
        """
        if self._closed:
            return
        self._closed = True
        self.dispatcher.fault = lambda: BusClosed("the bus was closed")
        # Remove polls first: a cycle that is released between two batches of failures would fail request by request.
        for poll in list(self.dispatcher.schedule.polls):
            self.dispatcher.remove_poll(poll, now)
        self.dispatcher.fail_all(now)
        # Finish the exchange on the wire: its reply would otherwise reach the next master of this line.
        if self.state is not EXCHANGE:
            self._go_offline(now)

    @property
    def failing(self) -> bool:
        """True while requests that failed with the line have not ended yet. Further calls of `handle_timeout` end
        them."""
        return len(self.dispatcher.failing) > 0

    # outputs, pumped in this order

    def poll_transmit(self) -> bytes | None:
        """Return the bytes to send now, or None. Each byte is returned once."""
        output = self._wire.output
        data = output.waiting
        if not data:
            return None
        output.waiting = b""
        return data

    @property
    def sent_until(self) -> float:
        """Time at which all sent bytes are on the wire, in seconds on the caller's clock, if the port holds none
        back."""
        return self._step.out

    def poll_event(self) -> Event | None:
        """Remove and return the next event, in the order of `events`, or None."""
        if self.dispatcher.unnoted is not None:
            self.dispatcher.note_success()  # deferred until here, so that the next request leaves first
        return self.events.popleft() if self.events else None

    def poll_timeout(self) -> float:
        """Return when to call `handle_timeout`, in seconds on the caller's clock; inf if no deadline is set."""
        # Called after each received byte. A call of `min` takes more than twice as long.
        line, other = self._deadlines.line, self._deadlines.earliest_other
        return line if line < other else other

    def reset_statistics(self, now: float) -> None:
        """Reset the counters of the line and of its nodes."""
        self._counters.reset(self.state, now)
        for node in self.dispatcher.nodes:
            node.counters.reset()

    def statistics(self, now: float) -> LineStatistics:
        """Return an immutable snapshot of the line's counters since the last reset. Times are in seconds."""
        return self._counters.snapshot(self.state, now, len(self.dispatcher.backlog))
