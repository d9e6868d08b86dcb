"""The one place where the state of a line changes.

Theory of operation
-------------------
One half-duplex line, many nodes, anonymous replies: at most one exchange is on the line (R1), and no byte of an earlier
one can come when the next begins (R3), unless its window was learned (R15). It is told the time and sends nothing: its
owner pumps `poll_transmit`, then `poll_event`, and arms a timer for `poll_timeout`. Calls too early change nothing.

The line is in one of five states; `_deadlines.line` is when the state ends by itself.

=========  =====================  =======================  ==========================  ====================
state      data received          its deadline             line_up / line_down         submit, poll due
=========  =====================  =======================  ==========================  ====================
OFFLINE    counted, dropped       never                    up: SETTLING                fails with LineDown
READY      unasked: SETTLING      never                    down: OFFLINE               EXCHANGE
HOLDOFF    unasked: SETTLING      READY                    down: OFFLINE, all fail     waits
EXCHANGE   read: stays, or ends   window is over: stays    down: OFFLINE, all fail     waits
           in READY, HOLDOFF      until the lateness is;
           or SETTLING            then, or gap is over:
                                  failed (SETTLING), next
                                  leg, or done (broadcast)
SETTLING   unasked: silence       READY                    down: OFFLINE, all fail     waits (NOISY: fails)
           again; 1 s of it:
           NOISY, all fail
=========  =====================  =======================  ==========================  ====================

READY never lasts while something waits: whatever leads to READY starts the next transaction in the same call.
An exchange ends in READY or HOLDOFF only when its outcome is certain: a reply that matches, with nothing behind it, or
a NAK to a write. Everything else settles, to silence and past the lateness (leg.py has the times).
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, cast

from busmaster.arbiter.choice import Choice
from busmaster.arbiter.counters import LineCounters
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.echo import Echo
from busmaster.arbiter.endings import HELD
from busmaster.arbiter.events import CameUnasked, LineChange, LineChanged
from busmaster.arbiter.health import DOWN
from busmaster.arbiter.in_step import InStep
from busmaster.arbiter.leg import UNKNOWN_LATENESS, Leg
from busmaster.arbiter.mark import Mark
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.state import EXCHANGE, HOLDOFF, OFFLINE, READY, SETTLING, LineState
from busmaster.arbiter.trust import COLLIDED, TOO_EARLY, TWO_ANSWERS, Trust, damaged
from busmaster.arbiter.unasked import LOOK_SLACK, QUIET, UnaskedBytes
from busmaster.contract.exchange import NO_REPLY, Done, Expect, FrameError
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import BusError, LineDown, LineNoisy, Refused


class LineMachine:
    """What the line does, and what comes of it. Its commands are the `Arbiter`'s, which is made of it."""

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
        self._leg = Leg(ReplyTiming(0.0, 0.0, UNKNOWN_LATENESS, QUIET), receive_latency, byte_time)
        self._in_step = InStep(strict)
        dispatcher = self.dispatcher
        self._wire = OnWire(
            self._leg, self._echo, self._deadlines, self._in_step, dispatcher.urgent_waits, dispatcher.is_wanted
        )
        self.dispatcher.is_held = lambda: self._wire.output.held
        self._choice = Choice(self.dispatcher, self._in_step, self._wire)
        self._trust = Trust(self._in_step)
        # the line
        self._unasked = UnaskedBytes(self.events, self._counters)
        self._up_at = self._quarantine = self._silent_at = -inf

    # inputs

    def line_up(self, now: float, *, paced: bool = False) -> None:
        """Note that the port is open, and settle first: what an earlier master asked may still be answered. If `paced`,
        bytes leave at the baud rate, so that a reply that comes earlier cannot be one (R4)."""
        if self.state is not OFFLINE or self._closed:
            return
        self._leg.paced = paced and not self._echo.declared
        self.dispatcher.fault = None
        self.events.append(LineChanged(LineChange.UP))
        lateness = max((node.lateness for node in self.dispatcher.nodes), default=UNKNOWN_LATENESS)
        self._up_at = now
        self._quarantine = now + lateness + self._leg.latency + self._leg.byte_time
        self._in_step.came_up()
        self._settle(now)

    def line_down(self, cause: str, now: float) -> None:
        """Fail everything, for the port is gone, and send nothing any more of what waited (R13)."""
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
        if self._echo.owed:
            data = self._strip_echo(data, now)
            if not data:
                return
        if self.state is not EXCHANGE:
            self._take_unasked(data, now)
        elif self._trust.held is not None:  # two answers where one is due: neither is believed
            self._disbelieve(TWO_ANSWERS, Done(None, data, self._trust.held.send), now)
        elif self._leg.begun:
            self._unasked.last_byte = now
            self._take(data, now)
        else:
            self._begin_reply(data, now)

    def byte_marked(self, mark: Mark, now: float) -> None:
        """Note that the UART says that a byte came damaged, or a break: whatever it was, it is nobody's answer."""
        self._counters.mark(mark)
        self._unasked.last_byte = now
        self._echo.forget()
        if self.state is EXCHANGE:
            self._leg.begun = True
            self._attempt_failed(FrameError(damaged(mark)), now)
        else:
            self._take_unasked(b"\0", now)

    def transmitted(self, now: float) -> None:
        """Note that the port took what `poll_transmit` gave only now: whoever held the process up meanwhile."""
        output = self._wire.output
        said_at = output.said_at
        late = now - said_at
        if late > 0.0:
            output.said_at = now
            leg = self._leg  # as leg.shift does: this is done for every request
            leg.end += late
            leg.out += late
            if leg.paced:
                leg.taint_until += late
            self._deadlines.line += late
            if self.state is SETTLING:
                self._silent_at += late
            if late > LOOK_SLACK and (asked := self._wire.transaction) is not None and asked.started == said_at:
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
        if self.state is SETTLING:
            self._settle(now)
            return self._deadlines.line
        return now + self._leg.timing.turnaround if self.state is HOLDOFF else inf

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
            elif self.state is SETTLING and now < self._silent_at:
                deadlines.line = self._unasked.look_before(self._silent_at, now)
            else:
                self._free(now)
        elif self.state is READY:
            self._advance(now)

    # one exchange

    def _advance(self, now: float) -> bool:
        """Start the next transaction, right behind our own last byte. Returns False if none waits."""
        if now < self._quarantine:
            self._settle(now)
            return True
        unasked = self._unasked
        chosen = self._choice.next(now, unasked.last_byte)
        if chosen is None:
            return False
        if type(chosen) is not tuple:
            self._quarantine = cast("float", chosen)
            self._settle(now, begun=True)
            return True
        transaction, exchange = chosen
        self.dispatcher.started(transaction, now)
        if self.state is not EXCHANGE:
            self._enter(EXCHANGE, now)
        self._wire.begin(transaction, exchange, now)
        if unasked.unanswered_one is not None:
            unasked.looked(now, self._deadlines.line)
        return True

    def _begin_reply(self, data: bytes, now: float) -> None:
        """Take the first bytes of a leg: those of them that may be its reply begin it."""
        wire, leg = self._wire, self._leg
        transaction = wire.transaction
        assert transaction is not None
        if now < leg.taint_until or wire.output.held:
            self._counters.tainted += 1
            self._unasked.last_byte = now
            self._attempt_failed(FrameError(TOO_EARLY, heard=data), now)
            return
        if not wire.answered:
            self._unasked.note(data, now, leg.quiet())
            wire.came_unasked = True
            return
        if transaction.node.profile.noise_tolerant:
            heard, data = data, wire.without_noise(data)
            self._counters.noise_bytes += len(heard) - len(data)
            if not data:
                self._unasked.last_byte = now  # noise that is passed over breaks a silence all the same
                return
        leg.begun = True
        leg.begun_at = now
        leg.first_bytes = data
        if transaction.first_byte == -inf:
            transaction.first_byte = now
        if now > leg.end + leg.timing.nominal + leg.latency:
            transaction.late = True
            if now > leg.end + leg.timing.window + leg.latency:
                transaction.overdue = True
        self._unasked.last_byte = now
        self._take(data, now)

    def _take(self, data: bytes | None, now: float) -> None:
        """Hand the reader these bytes, or the news (None) that none came in time, and do what it makes of them."""
        no_reply = data is None and not self._leg.begun
        try:
            exchange = self._wire.exchange
            assert exchange is not None
            step = exchange.expired(self._leg.begun) if data is None else exchange.feed(data)
            if type(step) is Expect:
                self._watch_max_reply_delay()  # now: the next leg takes the place of this one's times
                step = self._wire.follow(step, now)
        except FrameError as error:
            self._attempt_failed(error, now, no_reply=no_reply)
        except Refused as refusal:
            self._refused(refusal, now)
        except Exception as bug:
            self._attempt_failed(FrameError(f"a bug in the protocol's reader: {bug!r}"), now, bug=bug)
        else:
            if type(step) is Done:
                self._complete(step, now)
            elif self._leg.begun:
                self._deadlines.line = self._wire.gap_over(now)

    def _awaits_late_reply(self, now: float) -> bool:
        """Wait on for a reply that has not begun in its window, and return whether it may still begin.

        The line would settle until then anyway (R3), so a late reply that is right is worth waiting for, and costs
        nothing. A learned window ends the wait: the line goes on, and the reply is overdue (R15).
        """
        wire, leg, unasked = self._wire, self._leg, self._unasked
        if leg.begun or not wire.answered or leg.timing.silence is not None:
            return False
        if self._closed or self._echo.owed:  # who leaves waits for a window (R8); an echo that is lost hides the reply
            return False
        until = leg.last_begin()
        if now >= until:
            return False
        assert wire.transaction is not None
        unasked.unanswered(wire.transaction.node, leg.end, leg.timing.lateness)
        self._deadlines.line = unasked.look_before(until, now)
        return True

    def _watch_max_reply_delay(self) -> None:
        """Tell of a node whose reply to this leg began after its window; raise its lateness if that was near (R3)."""
        leg, transaction = self._leg, self._wire.transaction
        assert transaction is not None
        # an earlier leg may have been the late one
        if transaction.overdue and leg.begun and leg.begun_at > leg.end + leg.timing.window + leg.latency:
            self._unasked.note_late(transaction.node, leg.timing, leg.end, leg.begun_at)

    def _complete(self, step: Done[Any], now: float) -> None:
        """Deliver a value: the line is free when the closing ACK has left and the node has let go of the line."""
        wire, leg = self._wire, self._leg
        transaction, exchange = wire.transaction, wire.exchange
        assert transaction is not None
        assert exchange is not None
        answered, rest = wire.answered, step.rest
        alert = self._in_step.alert
        if alert and self._in_step.lone_bytes_until == inf:
            self._first_frame_ended()
        if answered:
            if alert or rest:
                verdict = self._trust.weigh(wire, step, now)
                if isinstance(verdict, str):
                    self._disbelieve(verdict, step, now)  # before what follows: it proves not that its request left
                    return
                if verdict is not None:
                    self._deadlines.line = verdict
                    return
            begun_at = leg.begun_at
            if transaction.overdue:  # asked here, too: this is done for every reply
                self._watch_max_reply_delay()
            if leg.end > begun_at:  # an unpaced port: what was answered has left, whatever the baud rate says
                leg.end = leg.out = begun_at
            transaction.node.note_reply(exchange.answers, transaction.command, begun_at - leg.end)
            if transaction.node.learning is not None:
                wire.learn(now)
        if step.send:
            wire.say(step.send, now)
        wire.transaction = wire.exchange = None  # and nothing is held: what was has been weighed again
        self._counters.exchanges += 1
        self.dispatcher.succeeded(transaction, step.value, now)
        if rest or wire.came_unasked or (self._echo.owed and not answered):  # a broadcast's echo may never come
            if rest:
                self._unasked.note(rest, now, leg.quiet())
            self._settle(now)
            return
        self._unasked.unanswered_one = None
        self._release(leg.timing.turnaround if answered else 0.0, now)

    def _disbelieve(self, what: str, step: Done[Any], now: float) -> None:
        self._counters.doubted += 1
        if self._wire.transaction is not None:
            self._wire.transaction.node.unheard = 0  # heard, if not believed: what it owes it is asked for itself
        if step.rest:
            self._unasked.note(step.rest, now, self._leg.quiet())
        self._attempt_failed(FrameError(what, send=step.send), now, doubted=True)

    def _attempt_failed(
        self,
        error: FrameError,
        now: float,
        no_reply: bool = False,
        doubted: bool = False,
        bug: Exception | None = None,
    ) -> None:
        transaction, leg, unasked = self._wire.transaction, self._leg, self._unasked
        assert transaction is not None
        if no_reply and self._wire.output.held:
            error.what, error.hint = "the port had not sent it when the bus was closed", HELD
        elif no_reply:
            unasked.unanswered(transaction.node, leg.end, leg.timing.lateness)
            if error.what == NO_REPLY:
                timing = leg.timing
                early = timing.silence is not None or self._closed or self._echo.owed  # see _awaits_late_reply
                awaited = timing.window if early else timing.lateness
                error.what = f"no reply within {awaited * 1000:g} ms"
            if self._echo.owed:
                error.what += ", and no echo of the request: if the adapter has none, leave echo out"
        else:
            if transaction.overdue:
                unasked.answered()  # what came late and is wrong may be noise: it makes no node slower
            if error.heard:
                unasked.came(now)
                unasked.run[:] = error.heard
        spared = error.whole and not self._in_step.is_overdue(
            now
        )  # its reply has begun: the silence alone is waited for (R3)
        both = error.what is TWO_ANSWERS
        if both:
            self._in_step.said_twice(now)
        self._trust.owe(self._wire, heard=not no_reply, whole=error.whole or both)
        if error.send:
            self._wire.say(error.send, now)
        self._end_exchange()
        if bug is None:
            self.dispatcher.attempt_failed(transaction, no_reply, error, now, doubted)
        else:
            self.dispatcher.broken(transaction, bug, now)
        self._settle(now, begun=spared)

    def _refused(self, refusal: Refused, now: float) -> None:
        """Take a refusal: a NAK to a write is certain; a NAK to a read may be noise before the true reply (R7).

        While something is owed, no refusal is certain: it may be an earlier request's (R15).
        """
        transaction = self._wire.transaction
        assert transaction is not None
        certain = not self._in_step.doubts_refusals(now)
        if not certain:
            self._trust.owe(self._wire, heard=False)
        elif transaction.writes:
            self._watch_max_reply_delay()
        confirmed = transaction.refusals > 0
        transaction.last_byte = now
        self._end_exchange()
        self.dispatcher.refused(transaction, refusal, certain, now)
        if transaction.writes and certain:
            self._leg.answered()  # what was refused has left, as what was answered has
            self._release(self._leg.timing.turnaround, now)
        else:
            self._settle(now, begun=confirmed and certain)

    def _first_frame_ended(self) -> None:
        """Tell R15 when no node can reply to the first frame any more, whether or not it was sent to that node."""
        lateness = max((node.lateness for node in self.dispatcher.nodes), default=UNKNOWN_LATENESS)
        self._in_step.lone_bytes_until = self._leg.out + lateness + self._leg.latency + self._leg.byte_time

    def _end_exchange(self) -> None:
        wire = self._wire
        if self._in_step.lone_bytes_until == inf:
            self._first_frame_ended()
        if wire.exchange is not None:
            self._leg.give_up(wire.exchange.later)
            self._leg.came_unasked(self._unasked.last_byte)  # what came in place of the reply may have been it, damaged
        wire.transaction = wire.exchange = self._trust.held = None
        self._counters.exchanges += 1

    # the line between exchanges

    def _release(self, hold: float, now: float) -> None:
        """Let the next request follow `hold` seconds behind our own last byte: the outcome was certain."""
        if self._closed:
            self._go_offline(now)
        elif hold or not self._advance(now):  # behind a closing ACK, in the same write: waiting for it took a timer
            free = hold + (self._leg.out if self._leg.out > now else now)  # a call of `max` takes three times as long
            self._enter(HOLDOFF if free > now else READY, now)
            self._deadlines.line = free if free > now else inf

    def _settle(self, now: float, begun: bool = False) -> None:
        """Discard until the line was silent long enough, and nothing can come any more (R3) unless it has `begun`."""
        if self._closed:
            self._go_offline(now)
            return
        if self.state is not SETTLING:
            self._counters.settles += 1
            self._enter(SETTLING, now)
        self._echo.forget()
        last = max(self._unasked.last_byte, self._leg.out)  # ours, too: who speaks on two wires does not hear
        silent = max(last + self._leg.quiet(), self._quarantine, now)
        goes_on = begun or self._leg.timing.silence is not None  # learned: what may still come is owed (R15)
        self._silent_at = silent if goes_on else max(silent, self._leg.past())
        self._deadlines.line = self._unasked.look_before(self._silent_at, now)

    def _free(self, now: float) -> None:
        """End a holdoff or a settle."""
        if self.state is SETTLING:
            self._leg.settled()
            self._hear_out(self._unasked.silent(), now)
            if self._answer_unasked(self._unasked.reply_to_silence(), now):
                return
            if self.noisy:
                self.noisy = False
                self.dispatcher.fault = None
                self.events.append(LineChanged(LineChange.QUIET))
        self._enter(READY, now)
        self._deadlines.line = self._unasked.look_before(inf, now)
        self._advance(now)

    def _take_unasked(self, data: bytes, now: float) -> None:
        """Take bytes that nobody asked for."""
        unasked = self._unasked
        unasked.note(data, now, self._leg.quiet())
        self._leg.came_unasked(now)
        if self.state is OFFLINE:
            return
        self._settle(now)
        self._answer_unasked(unasked.reply_to(data, self.noisy), now)
        if unasked.babbling(now) and not self.noisy:
            self.noisy = True
            self._counters.noisy += 1
            self.events.append(LineChanged(LineChange.NOISY))
            self.dispatcher.fault = lambda: LineNoisy("the line has not been silent for a second")
            self.dispatcher.fail_all(now)

    def _hear_out(self, run: bytes, now: float) -> None:
        """Take what came before this silence: whoever said it, and owed it, is alive (R11, R15)."""
        node = self._trust.hear(self._wire, run, self._unasked, now, self._echo.astray) if run else None
        if node is not None and node.health is DOWN:
            self.dispatcher.probes.alive(node, now)

    def _answer_unasked(self, send: bytes, now: float) -> bool:
        """Return True if an answer was owed: then the line settles again, and what was said just now echoes."""
        if send:
            self._wire.say(send, now)
            owed = self._echo.owed
            self._settle(now)
            self._echo.owed = owed  # which the settle forgot: this is echoed, too
        return bool(send)

    def _strip_echo(self, data: bytes, now: float) -> bytes:
        """Take the echo of what was sent off the front, byte for byte; a mismatch is a collision."""
        rest = self._echo.strip(data)
        self._unasked.last_byte = now  # where the echo is lost, this may be another's byte that looks like it
        if self.state is SETTLING:  # an ACK, then, before its packet (MSC)
            self._silent_at = max(self._silent_at, self._leg.came_unasked(now))
        if rest is None:
            self._counters.collisions += 1
            self.events.append(CameUnasked(data, collision=True))
            if self.state is EXCHANGE:
                self._attempt_failed(FrameError(COLLIDED), now)
            else:
                self._settle(now)
            return b""
        if not self._echo.owed and self.state is EXCHANGE and not self._leg.begun:
            self._wire.output.held = False  # it is heard, so it has left
            due = self._leg.echoed(now)
            self._deadlines.line = due if self._wire.answered else now + self._leg.timing.turnaround
        return rest

    def _go_offline(self, now: float) -> None:
        """Cut off whatever is on the wire."""
        transaction = self._wire.transaction
        self._enter(OFFLINE, now)
        self.noisy = False
        self._deadlines.line = inf
        self._echo.forget()
        self._unasked.forget()
        if transaction is not None:
            self._wire.output.discard()
            self._trust.owe(self._wire, heard=True)
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
