"""The one place where the state of a line changes.

Theory of operation
-------------------
One half-duplex line, many nodes, anonymous replies: at most one exchange is on the line (R1), and no byte of an earlier
one can come when the next begins (R3), unless its window was learned (R15). It is told the time and sends nothing: its
owner pumps `poll_transmit`, then `poll_event`, and arms a timer for `poll_timeout`. Calls too early change nothing.

The line is in one of five states; `_deadlines.line` is when the state ends by itself.

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

READY never lasts while something waits: whatever leads to READY starts the next transaction in the same call.
An exchange ends in READY or HOLDOFF only when its outcome is certain: a reply that matches, with nothing behind it, or
a NAK to a write. Everything else resynchronises, to silence and past the maximum reply delay (times: on_wire.py).

Time starts when bytes have left. `poll_transmit` hands them over; `transmitted` says when the port had taken them, and
`unsent`, asked for when a deadline of the line falls due, how many have not left yet: until then, nothing runs out.

What goes next is chosen in choice.py, by what is overdue (in_sync.py). What becomes of a failed attempt is
dispatcher.py's business.
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
from busmaster.arbiter.tap import Attempt
from busmaster.arbiter.transaction import HELD, Poll, Transaction
from busmaster.arbiter.trust import COLLIDED, TOO_EARLY, TWO_ANSWERS, Trust, damaged
from busmaster.arbiter.unexpected import LOOK_SLACK, QUIET, UnexpectedBytes
from busmaster.contract.exchange import NO_REPLY, Done, Expect, FrameError
from busmaster.contract.learning import Learned, documented
from busmaster.contract.profile import Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import BusClosed, BusError, LineDown, LineNoisy, Refused


class Arbiter:
    """The arbiter of one line: its states, and the commands of its owner.

    `byte_time` is tau, in seconds. `echo`: what is sent is received too. `receive_latency`: seconds that received bytes
    may lie in an adapter. `capacity`: requests of one class that may wait. `jitter` returns numbers from 0 to 1, by
    which probes are spread. `strict`: answers that could be another's are held until that one would have come (R15).
    """

    name = ""
    """What errors call the line."""
    longest_hold = 0.0
    """Of the sequences that were begun, the longest time, in seconds, for which one may hold the line."""

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
        """Note that the port is open, and resynchronise first: what an earlier master asked may still be answered. If
        `paced`, bytes leave at the baud rate, so that a reply that comes earlier cannot be one (R4)."""
        if self.state is not OFFLINE or self._closed:
            return
        self._step.paced = paced and not self._echo.declared
        self.dispatcher.fault = None
        self.events.append(LineChanged(LineChange.UP))
        max_reply_delay = max((node.max_reply_delay for node in self.dispatcher.nodes), default=UNKNOWN_MAX_REPLY_DELAY)
        self._up_at = now
        self._quarantine = now + max_reply_delay + self._step.latency + self._step.byte_time
        self._in_sync.came_up()
        self._resynchronise(now)

    def line_down(self, cause: str, now: float) -> None:
        """Fail everything, for the port is gone, and send nothing any more of what waited (R13)."""
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
        """Note why the port does not come back: a request that fails says that, which is news, and not the loss."""
        self._cause, self._hint = cause, hint

    def data_received(self, data: bytes, now: float) -> None:
        """Take bytes as they come: an echo, a reply, or what nobody asked for."""
        # Before anything else: on an echoing port the first bytes are always our own.
        if self._echo.pending:
            data = self._strip_echo(data, now)
            if not data:
                return
        if self.state is not EXCHANGE:
            self._take_unexpected(data, now)
        elif self._trust.held is not None:  # two answers where one is due: neither is believed
            self._disbelieve(TWO_ANSWERS, Done(None, data, self._trust.held.send), now)
        elif self._step.begun:
            self._unexpected.last_byte = now
            self._take(data, now)
        else:
            self._begin_reply(data, now)

    def byte_marked(self, mark: Mark, now: float) -> None:
        """Note that the UART says that a byte came damaged, or a break: whatever it was, it is nobody's answer."""
        self._counters.mark(mark)
        self._unexpected.last_byte = now
        self._echo.forget()
        if self.state is EXCHANGE:
            self._step.begun = True
            self._attempt_failed(FrameError(damaged(mark)), now)
        else:
            self._take_unexpected(b"\0", now)

    def transmitted(self, now: float) -> None:
        """Note that the port took what `poll_transmit` gave only now: whoever held the process up meanwhile."""
        output = self._wire.output
        said_at = output.said_at
        late = now - said_at
        if late > 0.0:
            output.said_at = now
            step = self._step  # as step.shift does: this is done for every request
            step.end += late
            step.out += late
            if step.paced:
                step.taint_until += late
            self._deadlines.line += late
            if self.state is RESYNCHRONISING:
                self._silent_at += late
            # Not for an ACK within the exchange: the request left before, and its answer may be as old as that.
            asked = self._wire.transaction
            if late > LOOK_SLACK and output.begins and asked is not None and asked.started == said_at:
                asked.started = now

    def line_due(self, now: float) -> bool:
        """Return whether a deadline of the line falls due: `unsent` is to be told first, where it is known."""
        return now >= self._deadlines.line

    def unsent(self, count: int, now: float) -> None:
        """Note that so many of the bytes said have not left: until they have, nothing runs out, nothing else is said
        and nothing is their answer. The caller tells it again, then, before the bytes that come.

        A line that is being closed does not wait for them: that they have not left is noted, for the error.
        """
        again = self._wire.output.unsent(count, now)
        if again is not None and (again == inf or not self._closed):
            self._deadlines.line = self._due_anew(now) if again == inf else again

    def _due_anew(self, now: float) -> float:
        """Return the deadline of the line, from the end of what has only just left."""
        if self.state is EXCHANGE:
            return self._wire.due_anew(now)
        if self.state is RESYNCHRONISING:
            self._resynchronise(now)
            return self._deadlines.line
        return now + self._step.timing.driver_release_time if self.state is HOLDOFF else inf

    def handle_timeout(self, now: float, *, unread: bool = False) -> None:
        """Do what is due. If `unread`, bytes have come that were not handed over: the line's silence is not known."""
        deadlines = self._deadlines
        if now >= deadlines.earliest_other:
            self.dispatcher.handle_timeout(now, unread)
            if now >= deadlines.health:
                self._enter(self.state, now)
                self.dispatcher.probe(now, self.state is READY)
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
        """Start the next transaction, right behind our own last byte. Returns False if none waits."""
        if now < self._quarantine:
            self._resynchronise(now)
            return True
        unexpected = self._unexpected
        action = self._choice.next(now, unexpected.last_byte)
        if isinstance(action, Idle):
            return False
        if isinstance(action, WaitUntil):
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
        """Take the first bytes of a step: those of them that may be its reply begin it."""
        wire, step = self._wire, self._step
        transaction = wire.transaction
        assert transaction is not None
        if now < step.taint_until or wire.output.held:
            self._counters.tainted += 1
            self._unexpected.last_byte = now
            self._attempt_failed(FrameError(TOO_EARLY, heard=data), now)
            return
        if not wire.answered:
            self._unexpected.note(data, now, step.quiet())
            wire.came_unexpected = True
            return
        if transaction.node.profile.noise_tolerant:
            heard, data = data, wire.without_noise(data)
            self._counters.noise_bytes += len(heard) - len(data)
            if not data:
                self._unexpected.last_byte = now  # noise that is passed over breaks a silence all the same
                return
        step.begun = True
        step.begun_at = now
        step.first_bytes = data
        if transaction.first_byte == -inf:
            transaction.first_byte = now
        if now > step.end + step.timing.late_after + step.latency:
            transaction.late = True
            if now > step.end + step.timing.window + step.latency:
                transaction.overdue = True
        self._unexpected.last_byte = now
        self._take(data, now)

    def _take(self, data: bytes | None, now: float) -> None:
        """Hand the reader these bytes, or the news (None) that none came in time, and do what it makes of them."""
        no_reply = data is None and not self._step.begun
        try:
            exchange = self._wire.exchange
            assert exchange is not None
            progress = exchange.expired(self._step.begun) if data is None else exchange.feed(data)
            if type(progress) is Expect:
                self._watch_max_reply_delay()  # now: the next step takes the place of this one's times
                progress = self._wire.follow(progress, now)
        except FrameError as error:
            self._attempt_failed(error, now, no_reply=no_reply)
        except Refused as refusal:
            self._refused(refusal, now)
        # A bug in one protocol must not end the line of all other nodes; it is reported with the request.
        except Exception as bug:
            self._attempt_failed(FrameError(f"a bug in the protocol's reader: {bug!r}"), now, bug=bug)
        else:
            if type(progress) is Done:
                self._complete(progress, now)
            elif self._step.begun:
                self._deadlines.line = self._wire.gap_over(now)

    def _awaits_late_reply(self, now: float) -> bool:
        """Wait on for a reply that has not begun in its window, and return whether it may still begin.

        The line would resynchronise until then anyway (R3), so a late reply that is right is worth waiting for, and
        costs nothing. A learned window ends the wait: the line goes on, and the reply is overdue (R15).
        """
        wire, step, unexpected = self._wire, self._step, self._unexpected
        if step.begun or not wire.answered or step.timing.silence is not None:
            return False
        if (
            self._closed or self._echo.pending
        ):  # who leaves waits for a window (R8); an echo that is lost hides the reply
            return False
        # R2: no reply can begin after the maximum reply delay, so no caller waits longer for one.
        until = step.last_begin()
        if now >= until:
            return False
        assert wire.transaction is not None
        unexpected.unanswered(wire.transaction.node, step.end, step.timing.max_reply_delay)
        self._deadlines.line = unexpected.look_before(until, now)
        return True

    def _watch_max_reply_delay(self) -> None:
        """Tell of a node whose reply to this step began after its window; raise its maximum reply delay if that was
        near (R3)."""
        step, transaction = self._step, self._wire.transaction
        assert transaction is not None
        # an earlier step may have been the late one
        if transaction.overdue and step.begun and step.begun_at > step.end + step.timing.window + step.latency:
            self._unexpected.note_late(transaction.node, step.timing, step.end, step.begun_at)

    def _complete(self, progress: Done[Any], now: float) -> None:
        """Deliver a value: the line is free when the closing ACK has left and the node has let go of the line."""
        wire, step = self._wire, self._step
        transaction, exchange = wire.transaction, wire.exchange
        assert transaction is not None
        assert exchange is not None
        answered, rest = wire.answered, progress.rest
        alert = self._in_sync.alert
        if alert and self._in_sync.lone_bytes_until == inf:
            self._first_frame_ended()
        if answered:
            if alert or rest:
                verdict = self._trust.weigh(wire, progress, now)
                if isinstance(verdict, str):
                    self._disbelieve(verdict, progress, now)  # before what follows: it proves not that its request left
                    return
                if verdict is not None:
                    self._deadlines.line = verdict
                    return
            begun_at = step.begun_at
            if transaction.overdue:  # asked here, too: this is done for every reply
                self._watch_max_reply_delay()
            if step.end > begun_at:  # an unpaced port: what was answered has left, whatever the baud rate says
                step.end = step.out = begun_at
            transaction.node.note_reply(exchange.answers, transaction.command, begun_at - step.end)
            if transaction.node.learning is not None:
                wire.learn(now)
        if progress.send:
            wire.say(progress.send, now)
        wire.transaction = wire.exchange = None  # and nothing is held: what was has been weighed again
        self._counters.exchanges += 1
        self.dispatcher.succeeded(transaction, progress.value, now)
        if rest or wire.came_unexpected or (self._echo.pending and not answered):  # a broadcast's echo may never come
            if rest:
                self._unexpected.note(rest, now, step.quiet())
            self._resynchronise(now)
            return
        self._unexpected.unanswered_one = None
        self._release(step.timing.driver_release_time if answered else 0.0, now)

    def _disbelieve(self, what: str, progress: Done[Any], now: float) -> None:
        self._counters.ambiguous += 1
        if self._wire.transaction is not None:
            self._wire.transaction.node.unheard = 0  # heard, if not believed: what it owes it is asked for itself
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
        elif no_reply:
            unexpected.unanswered(transaction.node, step.end, step.timing.max_reply_delay)
            if error.what == NO_REPLY:
                timing = step.timing
                early = timing.silence is not None or self._closed or self._echo.pending  # see _awaits_late_reply
                awaited = timing.window if early else timing.max_reply_delay
                error.what = f"no reply within {awaited * 1000:g} ms"
            if self._echo.pending:
                error.what += ", and no echo of the request: if the adapter has none, leave echo out"
        else:
            if transaction.overdue:
                unexpected.answered()  # what came late and is wrong may be noise: it makes no node slower
            if error.heard:
                unexpected.came(now)
                unexpected.run[:] = error.heard
        spared = error.whole and not self._in_sync.is_overdue(
            now
        )  # its reply has begun: the silence alone is waited for (R3)
        both = error.what is TWO_ANSWERS
        if both:
            self._in_sync.said_twice(now)
        self._trust.add_overdue(self._wire, heard=not no_reply, whole=error.whole or both)
        if error.send:
            self._wire.say(error.send, now)
        self._end_exchange()
        if bug is None:
            self.dispatcher.attempt_failed(transaction, no_reply, error, now, ambiguous)
        else:
            self.dispatcher.broken(transaction, bug, now)
        self._resynchronise(now, begun=spared)

    def _refused(self, refusal: Refused, now: float) -> None:
        """Take a refusal: a NAK to a write is certain; a NAK to a read may be noise before the true reply (R7).

        While something is overdue, no refusal is certain: it may be an earlier request's (R15).
        """
        transaction = self._wire.transaction
        assert transaction is not None
        certain = not self._in_sync.refusals_are_ambiguous(now)
        if not certain:
            self._trust.add_overdue(self._wire, heard=False)
        elif transaction.writes:
            self._watch_max_reply_delay()
        confirmed = transaction.refusals > 0
        transaction.last_byte = now
        self._end_exchange()
        self.dispatcher.refused(transaction, refusal, certain, now)
        if transaction.writes and certain:
            self._step.answered()  # what was refused has left, as what was answered has
            self._release(self._step.timing.driver_release_time, now)
        else:
            self._resynchronise(now, begun=confirmed and certain)

    def _first_frame_ended(self) -> None:
        """Tell R15 when no node can reply to the first frame any more, whether or not it was sent to that node."""
        max_reply_delay = max((node.max_reply_delay for node in self.dispatcher.nodes), default=UNKNOWN_MAX_REPLY_DELAY)
        self._in_sync.lone_bytes_until = self._step.out + max_reply_delay + self._step.latency + self._step.byte_time

    def _end_exchange(self) -> None:
        wire = self._wire
        if self._in_sync.lone_bytes_until == inf:
            self._first_frame_ended()
        if wire.exchange is not None:
            self._step.give_up(wire.exchange.later)
            self._step.came_unexpected(
                self._unexpected.last_byte
            )  # what came in place of the reply may have been it, damaged
        wire.transaction = wire.exchange = self._trust.held = None
        self._counters.exchanges += 1

    # the line between exchanges

    def _release(self, hold: float, now: float) -> None:
        """Let the next request follow `hold` seconds behind our own last byte: the outcome was certain."""
        if self._closed:
            self._go_offline(now)
        elif hold or not self._advance(now):  # behind a closing ACK, in the same write: waiting for it took a timer
            free = hold + (self._step.out if self._step.out > now else now)  # a call of `max` takes three times as long
            self._enter(HOLDOFF if free > now else READY, now)
            self._deadlines.line = free if free > now else inf

    def _resynchronise(self, now: float, begun: bool = False) -> None:
        """Discard until the line was silent long enough, and nothing can come any more (R3) unless it has `begun`."""
        if self._closed:
            self._go_offline(now)
            return
        if self.state is not RESYNCHRONISING:
            self._counters.resyncs += 1
            self._enter(RESYNCHRONISING, now)
        self._echo.forget()
        last = max(self._unexpected.last_byte, self._step.out)  # ours, too: who speaks on two wires does not hear
        silent = max(last + self._step.quiet(), self._quarantine, now)
        goes_on = begun or self._step.timing.silence is not None  # learned: what may still come is overdue (R15)
        self._silent_at = silent if goes_on else max(silent, self._step.past())
        self._deadlines.line = self._unexpected.look_before(self._silent_at, now)

    def _free(self, now: float) -> None:
        """End a holdoff or a resynchronisation."""
        if self.state is RESYNCHRONISING:
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
        """Take bytes that nobody asked for."""
        unexpected = self._unexpected
        unexpected.note(data, now, self._step.quiet())
        self._step.came_unexpected(now)
        if self.state is OFFLINE:
            return
        self._resynchronise(now)
        self._answer_unexpected(unexpected.reply_to(data, self.noisy), now)
        if unexpected.babbling(now) and not self.noisy:
            self.noisy = True
            self._counters.noisy += 1
            self.events.append(LineChanged(LineChange.NOISY))
            self.dispatcher.fault = lambda: LineNoisy("the line has not been silent for a second")
            self.dispatcher.fail_all(now)

    def _hear_out(self, run: bytes, now: float) -> None:
        """Take what came before this silence: whoever said it, and overdue it, is alive (R11, R15)."""
        node = self._trust.hear(self._wire, run, self._unexpected, now, self._echo.astray) if run else None
        if node is not None and node.health is DOWN:
            self.dispatcher.probes.alive(node, now)

    def _answer_unexpected(self, send: bytes, now: float) -> bool:
        """Return True if an answer was overdue: then the line resynchronises again, and what was said just now
        echoes."""
        if send:
            self._wire.say(send, now)
            overdue = self._echo.pending
            self._resynchronise(now)
            self._echo.pending = overdue  # which the resynchronisation forgot: this is echoed, too
        return bool(send)

    def _strip_echo(self, data: bytes, now: float) -> bytes:
        """Take the echo of what was sent off the front, byte for byte; a mismatch is a collision."""
        rest = self._echo.strip(data)
        self._unexpected.last_byte = now  # where the echo is lost, this may be another's byte that looks like it
        if self.state is RESYNCHRONISING:  # an ACK, then, before its packet (MSC)
            self._silent_at = max(self._silent_at, self._step.came_unexpected(now))
        if rest is None:
            self._counters.collisions += 1
            self.events.append(CameUnexpected(data, collision=True))
            if self.state is EXCHANGE:
                self._attempt_failed(FrameError(COLLIDED), now)
            else:
                self._resynchronise(now)
            return b""
        if not self._echo.pending and self.state is EXCHANGE and not self._step.begun:
            self._wire.output.held = False  # it is heard, so it has left
            due = self._step.echoed(now)
            self._deadlines.line = due if self._wire.answered else now + self._step.timing.driver_release_time
        return rest

    def _go_offline(self, now: float) -> None:
        """Cut off whatever is on the wire."""
        transaction = self._wire.transaction
        self._enter(OFFLINE, now)
        self.noisy = False
        self._deadlines.line = inf
        self._echo.forget()
        self._unexpected.forget()
        if transaction is not None:
            self._wire.output.discard()
            self._trust.add_overdue(self._wire, heard=True)
            self._end_exchange()
            self.dispatcher.cut_off(transaction, self._offline(), now)

    def _enter(self, state: LineState, now: float) -> None:
        counters, before = self._counters, self.state
        spent = now - counters.entered
        counters.spent[before] += spent
        counters.entered = now
        if before is READY:
            self.dispatcher.probes.budget.idle(spent, state is not READY)
        self.state = state

    def _offline(self) -> BusError:
        return LineDown(f"the line is down: {self._cause}", hint=self._hint)

    # what its owner asks of it

    @property
    def byte_time(self) -> float:
        """tau: seconds per byte of this line."""
        return self._step.byte_time

    @byte_time.setter
    def byte_time(self, seconds: float) -> None:
        self._step.byte_time = seconds

    @property
    def attempt(self) -> Attempt | None:
        """What is on the wire, on a line that is tapped."""
        tapped = self.dispatcher.tapped
        return None if tapped is None else tapped.attempt

    def set_tapped(self, tapped: bool) -> None:
        """Have `attempt` say what is on the wire, and the end of each attempt be an event, from now on, or no more."""
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

        Raises InvalidCommand for an address that the protocol does not have, and for learned windows where they cannot
        be learned (HCP).
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
            node.learning = Learning()
        self.dispatcher.nodes.append(node)
        # One listener per line: only one protocol of a line has replies to what nobody requested (MSC).
        if profile.listen is not None and self._unexpected.listener is None:
            self._unexpected.listener = profile.listen()
        # An earlier master may have asked this node just before the port was opened: that reply is waited out (R3).
        self._quarantine = max(
            self._quarantine, self._up_at + node.max_reply_delay + self._step.latency + self.byte_time
        )
        return node

    def remove_node(self, node: NodeRecord) -> None:
        """Remove a node: the line sends it no probe and no sync read any more.

        An exchange with it that is on the wire runs out. Its overdue replies stay overdue (R15): another node's reply
        clears them, as it does for a node that is silent.
        """
        # Its record lives on in what is overdue and in statistics that callers hold.
        node.removed = True
        self.dispatcher.nodes.remove(node)
        self.dispatcher.writes.forget_empty()
        self.dispatcher.probes.plan()

    def ask_within_budget(self, node: NodeRecord, now: float) -> None:
        """Treat a new node as down until its first reply: it is asked within the budget of probes only (R11)."""
        node.health, node.budgeted, node.probe_at = DOWN, True, now
        self.dispatcher.probes.plan()

    def name_node(self, node: NodeRecord, label: str) -> None:
        """Have messages call the node by this label."""
        node.label = label

    def change_profile(self, node: NodeRecord, profile: Profile) -> None:
        """Go by another profile of the node's protocol from now on: one that merges otherwise."""
        node.profile = profile

    def expect_hook(self, node: NodeRecord, expected: bool) -> None:
        """Hold the node's polls when it comes back until `Dispatcher.release_node`, or do not, as `expected` says."""
        node.has_hook = expected

    def note_stop(self, node: NodeRecord) -> None:
        """Count that the node is told to stop."""
        node.stops += 1

    def answer_counts(self, now: float) -> bool:
        """Return whether a caller's time is over while something is on the wire: what has come is handed over first."""
        # A loop that stood still may look at its timers before it reads: what lies unread came in time.
        return self.state is EXCHANGE and now >= self._deadlines.expiry

    def add_client(self, share: float = 1.0, owner_time: float = 0.0, user: Hashable = None) -> LineClient:
        """Return a client with whom the line's owner and other clients take turns from now on (R9)."""
        client = LineClient(share, user=user)
        self.dispatcher.share().admit(client, owner_time)
        return client

    def change_client(self, client: LineClient, owner_time: float) -> None:
        """Give a client another `owner_time`, as its role has changed."""
        self.dispatcher.share().admit(client, owner_time)

    def remove_client(self, client: LineClient) -> None:
        """Forget a client, who has nothing waiting; what it may still have on the wire runs out."""
        client.over = True
        self.dispatcher.share().forget(client)

    def exclusive(self, node: NodeRecord, client: LineClient | None, longest: float) -> Hold:
        """Return what requests name as their client that are one sequence: see `Hold`. It ends with `release`."""
        self.dispatcher.share()
        self.longest_hold = max(self.longest_hold, longest)
        return Hold(node, OWN if client is None else client, longest)

    def release(self, hold: Hold, now: float) -> None:
        """End a sequence: the line is free for others; what of it was not sent ends as HoldEnded."""
        if not hold.over:
            self.dispatcher.end_hold(now, hold)
        if self.state is READY:
            self._advance(now)

    def submit(self, transaction: Transaction, now: float) -> bool:
        """Queue a transaction, or end it at once.

        Returns False if it waits and nothing else has changed: then there is nothing to pump.
        """
        changed = self.dispatcher.submit(transaction, now)
        if self.state is READY:
            self._advance(now)
            return True
        return changed

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Cancel a transaction, synchronously and without ever touching the line (R6)."""
        self.dispatcher.cancel(transaction, now)

    def supersede_writes(self, now: float) -> None:
        """End whatever waits to be written as Superseded: the line is taken to its safe state."""
        self.dispatcher.supersede_writes(now)

    def add_poll(self, poll: Poll, now: float) -> None:
        """Run a poll from now on; its first cycle waits until a line that has just been opened can be used."""
        self.dispatcher.add_poll(poll, max(now, self._quarantine))

    def remove_poll(self, poll: Poll, now: float) -> None:
        """End a poll: what it has queued is never sent, and what it has on the wire goes unheard."""
        self.dispatcher.remove_poll(poll, now)

    def demand(self, poll: Poll, now: float) -> None:
        """Run one cycle of a poll now, off the grid."""
        self.dispatcher.demand(poll, now)
        if self.state is READY:
            self._advance(now)

    def close(self, now: float) -> None:
        """Fail whatever waits with BusClosed. The exchange on the wire runs out; then the line is OFFLINE.

        `failing` says whether some of it has not ended yet.
        """
        if self._closed:
            return
        self._closed = True
        self.dispatcher.fault = lambda: BusClosed("the bus was closed")
        # Polls first: a cycle that is released between two pieces would fail one by one.
        for poll in list(self.dispatcher.schedule.polls):
            self.dispatcher.remove_poll(poll, now)
        self.dispatcher.fail_all(now)
        # The exchange on the wire runs out: its reply would otherwise meet the next master of the line.
        if self.state is not EXCHANGE:
            self._go_offline(now)

    @property
    def failing(self) -> bool:
        """Whether some of what failed with the line has not ended yet: further calls of `handle_timeout` end it."""
        return len(self.dispatcher.failing) > 0

    # outputs, pumped in this order

    def poll_transmit(self) -> bytes | None:
        """Return the bytes that are to be sent now, which are handed over once, or None."""
        output = self._wire.output
        data = output.waiting
        if not data:
            return None
        output.waiting = b""
        return data

    @property
    def said_until(self) -> float:
        """When all that was said is on the wire, in seconds on the caller's clock, if the port holds none of it."""
        return self._step.out

    def poll_event(self) -> Event | None:
        """Take out the next event, in the order of `events`, or return None."""
        if self.dispatcher.unnoted is not None:
            self.dispatcher.note_success()  # only now: the next request has left
        return self.events.popleft() if self.events else None

    def poll_timeout(self) -> float:
        """Return when `handle_timeout` is to be called, in seconds on the caller's clock; inf if nothing is due."""
        # It is asked after every byte that comes. A call of `min` takes more than twice as long.
        line, other = self._deadlines.line, self._deadlines.earliest_other
        return line if line < other else other

    def reset_statistics(self, now: float) -> None:
        """Begin the counts of the line and of its nodes anew."""
        self._counters.reset(self.state, now)
        for node in self.dispatcher.nodes:
            node.counters.reset()

    def statistics(self, now: float) -> LineStatistics:
        """Return an immutable snapshot of the line's counts since the last reset; its times are in seconds."""
        return self._counters.snapshot(self.state, now, len(self.dispatcher.backlog))
