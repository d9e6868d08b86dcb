"""The shipping arbiter on a line with an adversary. One step is one event, at any time that it may have."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any, ClassVar, TypeAlias

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.counters import EXCHANGE, OFFLINE, Mark
from busmaster.arbiter.health import DOWN
from busmaster.arbiter.learned import Learning
from busmaster.arbiter.transaction import PARKED, URGENT, Transaction
from busmaster.arbiter.unexpected import QUIET
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import LineDown, NoReply, WriteUnconfirmed
from tests.verification.proof import setups
from tests.verification.proof.instants import Instant
from tests.verification.proof.kinds import KINDS, READ, WRITE, Kind
from tests.verification.proof.setups import Setup
from tests.verification.proof.shipped import ANY_STEP, BUDGET, NO_COUNTERS, Decided, no_jitter
from tests.verification.proof.wire import OLD, OWN, STRAY, Outside, Overdue, Ticket, Time, Violation, choose

Action: TypeAlias = tuple[Any, ...]
LONGEST_FRAME = 256
"""Bytes."""
MOST_TURNS = 50
"""Turns of the pump in one event, before it is thought not to rest."""
SECOND_TIMING = ReplyTiming(0.030, 0.030, 0.060, 0.010, driver_release_time=0.005)


class World:
    """The whole state: nothing outside it is remembered from one event to the next."""

    setup: ClassVar[Setup]
    """Of the world that is being explored."""
    kind: ClassVar[Kind]
    has_one_step: ClassVar[bool] = True
    """All that is heard in an exchange is its one reply."""
    byte_time: ClassVar[float]

    @classmethod
    def prepare(cls, setup: Setup) -> None:
        cls.setup = setup
        kind = KINDS[setup.kind]()
        timings = kind.profile.timings
        if setup.max_reply_delay:
            window = setup.max_reply_delay * 2 / 3
            timings = Timings.uniform(
                ReplyTiming(window, window, setup.max_reply_delay, 0.02, timings.read.driver_release_time)
            )
        checks = (kind.commands[READ][1], kind.check) if setup.in_sync else (kind.check,)
        if not setup.in_sync:  # `late_after` sorts replies that count into prompt and late ones
            read, write, packet = (
                replace(t, late_after=t.window) for t in (timings.read, timings.write, timings.packet)
            )
            timings = Timings(read, write, packet)
        cls.kind = replace(kind, profile=replace(kind.profile, sync_reads=checks, timings=timings))
        cls.byte_time = cls.kind.profile.line.byte_time

    def __init__(self, now: Time) -> None:
        setup, profile = self.setup, self.kind.profile
        self.arbiter = arbiter = Arbiter(
            self.byte_time,
            echo=setup.echo,
            receive_latency=setup.receive_latency,
            jitter=no_jitter,
            strict=setup.strict,
        )
        # The stand-ins (shipped.py) have what is asked of them, not the types: hence what is ignored here.
        arbiter._counters = arbiter._unexpected._counters = arbiter.dispatcher.counters = NO_COUNTERS  # type: ignore[assignment]  # stand-in
        arbiter.dispatcher.probes.budget = BUDGET  # type: ignore[assignment]  # one that may or may not
        if not setup.in_sync:
            arbiter._in_sync = arbiter._choice._in_sync = arbiter._trust._in_sync = ANY_STEP  # type: ignore[assignment]  # any R15
            arbiter._wire._in_sync = ANY_STEP  # type: ignore[assignment]  # likewise
        several = 1 + max(self.kind.commands[place][0] for place in setup.commands)
        for place in range(several):
            timings = Timings.uniform(SECOND_TIMING) if setup.second_timing and place else None
            address = place + self.kind.first if profile.addressed else 0
            node = arbiter.add_node(profile, address, 0.0, timings=timings, retries=setup.retries)
            node.learning = Learning() if setup.learned is not None else None
            node.counters = NO_COUNTERS  # type: ignore[assignment]  # a stand-in that counts nothing
        self.nodes = tuple(arbiter.dispatcher.nodes)
        self.now = now
        self.overdue: list[Overdue] = []
        self.live: list[Ticket] = []
        """The callers that wait."""
        self.by: str | None = None
        """What caused the last byte that came since the last request left."""
        self.forged = False
        """A byte that nobody said has come since then."""
        self.unread: tuple[tuple[int, str], ...] = ()
        """Bytes that lie in the adapter or the kernel, each with what caused it."""
        self.unread_by: Time = -inf
        """When the first of them is read at the latest."""
        self.strays = self.cancels = 1
        self.urgent = 1
        self.hold_until: Time = -inf
        """The driver of the last node that spoke holds the line until then."""
        self.held: tuple[bytes, Ticket | None] | None = None
        """What the port has not sent yet."""
        self.frozen: bytes = b""
        """What the arbiter has said, and the process has not written yet."""
        self.said = b""
        """What left in this step."""
        self.ended: list[str] = []
        """What callers were told in this step."""
        self.calls: list[tuple[Time, str, Any]] | None = None
        """What was called and said, with its time, where a history is told."""
        self.losses = setup.lost_acknowledgements
        self.said_by: Time = -inf
        """Until then the host speaks."""
        arbiter.line_up(now, paced=setup.paced)
        if setup.in_sync:  # a line in use: no node holds a part of an earlier master's frame
            arbiter._in_sync.lone_bytes_until = -inf

    def own_actions(self) -> list[Action]:
        """What may happen in a world of this kind alone."""
        return []

    def do(self, action: Action) -> None:
        """Let such a thing happen."""
        raise AssertionError(action)

    def note(self, what: str, detail: Any = None) -> None:
        if self.calls is not None:
            self.calls.append((self.now, what, detail))

    # what its owner does

    def ask(self, place: int, urgent: bool = False) -> None:
        """A caller submits one of the commands."""
        self.note("asks urgently" if urgent else "asks", place)
        transaction = self.made(place, self.whose())
        if urgent:
            transaction.priority = URGENT
        self.arbiter.submit(transaction, self.now)

    def made(self, place: int, client: LineClient | None) -> Transaction:
        """A new request of somebody, who waits for it from now on."""
        node, command = self.kind.commands[place]
        ticket = Ticket(node, command.writes, client)
        self.live.append(ticket)
        return Transaction(self.nodes[node], command, tag=ticket, client=client)

    @property
    def ranks(self) -> dict[LineClient, int]:
        """The order in which those who take turns are told."""
        return {}

    def whose(self) -> LineClient | None:
        """Who asks: here the program that owns the line alone."""
        return None

    @property
    def is_saturated(self) -> bool:
        """Something is asked whenever the line is free."""
        return not (self.setup.depth or self.setup.may(setups.IDLE)) and self.arbiter.dispatcher.fault is None

    def ask_one(self) -> None:
        """A caller submits something in the moment in which the line is free."""
        if self.is_saturated:
            commands = self.setup.commands
            place = commands[choose(len(commands))]
            self.note("asks", place)
            self.arbiter.dispatcher.submit(self.made(place, self.whose()), self.now)

    def pump(self) -> None:
        """Hand over what is to be sent, hear what has happened, ask anew: until nothing is left."""
        arbiter = self.arbiter
        by = self.by
        if Decided.by_answer[0] and (by == STRAY or (self.forged and self.has_one_step)):
            raise Outside  # a byte that nobody said was taken for an answer, or made one
        for _ in range(MOST_TURNS):
            out = arbiter.poll_transmit()
            if out:
                self.note("says", out)
                self.begin_exchange()
                if self.setup.may(setups.FROZEN) and choose(2):
                    self.frozen = out
                else:
                    self._write(out)
            ended = False
            while (event := arbiter.poll_event()) is not None:
                if type(event) is Transaction:
                    self._judge(event, by)
                ended = True
            if self.frozen or not (self._asks_more() or out or ended):
                self._check_rest()
                return
        raise Violation("progress: the pump does not rest")

    def _asks_more(self) -> bool:
        arbiter = self.arbiter
        waits = len(arbiter.dispatcher.backlog)
        if self.setup.may(setups.IDLE) or waits >= self.setup.depth or arbiter.dispatcher.fault is not None:
            return False
        commands = self.setup.commands
        self.ask(commands[choose(len(commands))])
        return len(arbiter.dispatcher.backlog) > waits or arbiter._wire.output.waiting != b""

    def _check_rest(self) -> None:
        """R8 and progress: nobody is forgotten, and the line's state has an end."""
        arbiter = self.arbiter
        wire, deadlines = arbiter._wire, arbiter._deadlines
        if deadlines.hold < self.now:  # what is overdue is due now, before any time passes
            deadlines.hold = self.now
        held = [w for node in self.nodes for w in arbiter.dispatcher.writes.queues[node] if w.phase is PARKED]
        held += [transaction for queue in arbiter.dispatcher.backlog.queues for transaction in queue]
        held += [wire.transaction] if wire.transaction is not None else []
        if len(self.live) > sum(transaction.wanted and transaction.tag is not None for transaction in held):
            raise Violation("R8: a request is forgotten")
        if arbiter.state.name in ("EXCHANGE", "RESYNCHRONISING", "HOLDOFF") and not self.frozen:
            due: Time = deadlines.line
            if type(due) is not Instant:
                raise Violation(f"progress: {arbiter.state.name} has no end")
            if due > self.now + self._longest_deadline():
                raise Violation(f"progress: {arbiter.state.name} ends later than it may")
        elif arbiter.state.name == "READY" and len(arbiter.dispatcher.backlog) and not self.is_held():
            raise Violation("progress: the line is READY while something waits")

    def is_held(self) -> bool:
        """The line waits for what a sequence asks next, and not for ever."""
        return False

    def _longest_deadline(self) -> float:
        """No deadline of the line is further away: a maximum reply delay with its bytes, behind all that is being said;
        or what R15 waits for."""
        setup, byte_time = self.setup, self.byte_time
        longest = 0.0
        for node in self.nodes:
            for timing in (node.timings.read, node.timings.write, node.timings.packet):
                whole = timing.max_reply_delay + timing.inter_byte_timeout + LONGEST_FRAME * byte_time
                longest = max(longest, whole, timing.max_reply_delay + timing.driver_release_time)
        later = 2 * setup.receive_latency + QUIET + LONGEST_FRAME * byte_time
        return longest + later + setup.lapse

    # what is promised

    def _judge(self, transaction: Transaction, by: str | None) -> None:
        ticket = transaction.tag
        if ticket is None:  # a probe's, or a check's
            return
        if ticket not in self.live:
            raise Violation("R8: a request ended twice")
        self.live.remove(ticket)
        error = transaction.error
        self.ended.append(f"{transaction.value} {type(error).__name__}")
        if error is not None:
            if ticket.writes and ticket.undenied and not isinstance(error, WriteUnconfirmed):
                if self.forged:
                    raise Outside
                raise Violation(f"R7: a write that may have been carried out ends as {type(error).__name__}")
            if isinstance(error, LineDown) and self.arbiter.state is not OFFLINE:
                raise Violation("R13: LineDown on a line that is up")
            if isinstance(error, NoReply):
                self._judge_silence(ticket)
            return
        if by is None:
            raise Violation("R5: a success though nothing was heard")
        value = transaction.value
        value = value[0] if isinstance(value, tuple) else value
        right = ticket.writes or float(value) == self.kind.right_value(transaction.command, ticket.place)
        if by == OLD:
            what = "a write is confirmed" if ticket.writes else "a value is made"
            raise Violation(f"R3: {what} by a byte of an earlier reply")
        if by == STRAY or (self.forged and not right):
            raise Outside
        if not right:
            raise Violation("R5: a wrong value")

    def _judge_silence(self, ticket: Ticket) -> None:
        """R2, as a caller is told that no reply came: none can come in time any more. A learned window ends sooner, and
        so does an exchange whose echo is lost. What comes `beyond` its maximum reply delay is for R15."""
        if self.setup.learned is not None or self.setup.echo or self.setup.beyond:
            return
        for reply in self.overdue:
            if reply.own and reply.ticket is ticket and not reply.begun and reply.hi > self.now:
                raise Violation("R2: a request ends as NoReply while its reply may still come in time")

    def _judge_request(self, old: list[Overdue]) -> None:
        """R1 and R3, as a request leaves: nothing of an earlier exchange can come any more."""
        if self.now < self.hold_until:
            raise Violation("R1: a node's driver still holds the line as the next request leaves")
        if self.setup.beyond:
            return
        for reply in old:
            if reply.hi > self.now:
                if self.calls is not None:
                    self.calls.append((reply.hi, "may still come until here", reply.data))
                begun = "the rest of a reply" if reply.begun else "a reply"
                raise Violation(f"R1: {begun} to an earlier request may still come as the next one leaves")
        if any(origin != STRAY for _, origin in self.unread):
            raise Violation("R1: bytes of an earlier reply lie unread as the next request leaves")

    def _judge_turn(self, transaction: Transaction) -> None:
        """R9, as a request leaves: here nobody holds the line."""

    def _judge_order(self, ticket: Ticket) -> None:
        """R7: no write overtakes an earlier one of its client to its node; what has ended, and is told with the next
        events, is not overtaken."""
        over = [event.tag for event in self.arbiter.events if type(event) is Transaction]
        for other in self.live:
            if other is ticket:
                return
            alike = other.node == ticket.node and other.client is ticket.client and other not in over
            if other.writes and ticket.writes and alike and not other.sent and not ticket.sent:
                raise Violation("R7: a write overtakes an earlier one to its node")

    # what is said

    def _write(self, out: bytes) -> None:
        """The port is handed these bytes."""
        self.said += out
        transaction = self.arbiter._wire.transaction
        ticket = None if transaction is None else transaction.tag
        if ticket is not None and self.is_request(out):
            assert transaction is not None
            self._judge_turn(transaction)
            self._judge_order(ticket)
            # A stray byte may be the NAK that has it sent again: no master can tell.
            sure = not self.setup.may(setups.STRAYS)
            if sure and ticket.writes and ticket.undenied and not transaction.command.idempotent:
                raise Violation("R7: a write that may have been carried out is sent again")
            ticket.sent = True
            ticket.undenied += 1
        if self.setup.may(setups.HELD) and choose(2):
            self.held = (out, ticket)
        else:
            self.leaves(out, ticket, self.now + len(out) * self.byte_time)
        self.note("has written")
        self.arbiter.transmitted(self.now)

    def is_request(self, out: bytes) -> bool:
        return True

    def over(self, reply: Overdue, refused: bool = False, lost: bool = False) -> None:
        """A node has said all of this."""
        if reply.driver_release_time:
            self.hold_until = self.now + reply.driver_release_time

    def begin_exchange(self) -> None:
        """Nothing that was said before is anybody's answer now."""
        if self.held is not None:
            raise Violation("R1: a request is said while an earlier one has not left")
        replies = [reply for reply in self.overdue if reply.kind != "echo"]
        if any(echo.hi > self.now for echo in self.overdue if echo.kind == "echo"):
            raise Violation("R1: the echo of an earlier request is still to come as the next one leaves")
        self._judge_request(replies)
        self.begin_anew()
        if not self.setup.beyond:
            self.overdue = []

    def begin_anew(self) -> None:
        """A request begins: whatever was said or lies unread is not its answer."""
        for reply in self.overdue:
            reply.own = False
        self.unread = tuple((byte, OLD if origin == OWN else origin) for byte, origin in self.unread)
        self.by = None
        self.forged = False
        self.strays = self.cancels = 1

    def leaves(self, out: bytes, ticket: Ticket | None, end: Time) -> None:
        """The last byte of it is on the wire at `end`: from there its node has the maximum reply delay."""
        assumed, byte_time = self.setup.assumptions, self.byte_time
        timing, transaction = self.arbiter._step.timing, self.arbiter._wire.transaction
        if timing.silence is not None and transaction is not None:  # what is learned of a node binds it to nothing
            timings = transaction.node.timings
            timing = timings.write if transaction.writes else timings.read
        answers = [self.kind.answer(out, place) for place in range(2)]
        place = choose(2) if ticket is not None and answers[0] != answers[1] else 0
        if ticket is not None:
            ticket.place = place
        if self.setup.echo:
            echo = Overdue(out, end, end + self.setup.late_echo, 0.0, kind="echo")
            self.overdue.append(echo)
        begins = (self.setup.beyond or timing.max_reply_delay) + (byte_time if assumed.edge else 0.0)
        gap = timing.inter_byte_timeout + (byte_time if assumed.gap_edge else 0.0)
        earliest = end + byte_time if self.setup.paced or self.setup.echo else self.now
        reply = Overdue(answers[place], earliest, end + begins, gap)
        reply.ticket, reply.request = ticket, out
        reply.unit = 0 if transaction is None else self.nodes.index(transaction.node)
        reply.driver_release_time = timing.driver_release_time
        self.overdue.append(reply)

    def may_refuse(self, request: bytes) -> bool:
        """Return whether a node may refuse what it was asked so."""
        if self.kind.refuses_check:
            return True
        timings = self.kind.profile.timings
        return all(request != self.kind.check.open(node.address, timings).request for node in self.nodes)

    # what is heard

    def hear(self, data: bytes, origin: str) -> None:
        """These bytes arrive at the port: they are read at once, or lie there."""
        if self.arbiter.state is OFFLINE:
            return
        setup = self.setup
        if self.reads_late:
            if not self.unread:
                late = setup.receive_latency + (setup.stall if setup.may(setups.STALLS) else 0.0)
                self.unread_by = inf if self.frozen else self.now + late
            self.unread += tuple((byte, origin) for byte in data)
            return
        self.read(data, origin)

    @property
    def reads_late(self) -> bool:
        """What comes lies in the adapter or the kernel before it is read."""
        return bool(self.frozen or self.setup.receive_latency or self.setup.may(setups.STALLS))

    def read(self, data: bytes, origin: str) -> None:
        """The pump reads them."""
        self.by = origin
        self.forged = self.forged or origin == STRAY
        self.tell_unsent_if(self.arbiter._wire.output.held)
        self.note("hears", data)
        self.arbiter.data_received(data, self.now)

    def read_unread(self, several: int) -> None:
        read, self.unread = self.unread[:several], self.unread[several:]
        origins = {origin for _, origin in read}
        origin = OLD if OLD in origins else STRAY if read[-1][1] == STRAY else OWN
        self.forged = self.forged or STRAY in origins
        self.read(bytes(byte for byte, _ in read), origin)

    def tell_unsent_if(self, asked: bool) -> None:
        """As the pump does: how much has not left yet."""
        if asked and self.setup.may(setups.HELD):
            count = 0 if self.held is None else len(self.held[0])
            self.note("has not sent", count)
            self.arbiter.unsent(count, self.now)

    def refuse(self, reply: Overdue) -> bytes:
        """The node says NAK in place of this reply: it has carried nothing out."""
        if reply.ticket is not None and (reply.own or self.setup.beyond):
            reply.ticket.undenied -= 1
        return self.kind.refusal(reply.request)

    @property
    def words_are_read(self) -> bool:
        """Whether it makes a difference what comes, not only that it does: in an exchange, where an echo is awaited,
        where a listener reads packets and where R15 knows what was overdue. What comes in a later exchange is read
        there; R1 denies that there is such, but for what the port holds and for replies `beyond` their maximum reply
        delay.
        """
        arbiter, setup = self.arbiter, self.setup
        unsaid = self.held is not None or bool(self.frozen) or setup.beyond
        listens = arbiter._echo.pending or arbiter._unexpected.listener is not None or setup.in_sync
        return bool(arbiter.state is EXCHANGE or unsaid or listens)

    @property
    def on_wire(self) -> Transaction | None:
        return self.arbiter._wire.transaction if self.arbiter.state is EXCHANGE else None

    @property
    def may_probe(self) -> bool:
        """A node is down, and no probe is out."""
        dispatcher = self.arbiter.dispatcher
        usable = dispatcher.fault is None and dispatcher.probes._running is None
        return usable and any(node.health is DOWN for node in self.nodes)

    def ask_urgently(self) -> None:
        self.urgent = 0
        self.ask(WRITE, urgent=True)

    def cancel(self) -> None:
        self.cancels = 0
        transaction = self.arbiter._wire.transaction
        assert transaction is not None
        self.live.remove(transaction.tag)
        self.note("cancels")
        self.arbiter.cancel(transaction, self.now)

    def wake(self) -> None:
        """The process goes on: what came meanwhile is read now."""
        if self.unread:
            self.unread_by = self.now

    def time_out(self, unread: bool) -> None:
        self.note("is due", unread)
        self.arbiter.handle_timeout(self.now, unread=unread)

    def go_down(self) -> None:
        self.note("goes down")
        self.arbiter.line_down("lost", self.now)
        self.unread = ()
        self.held = None

    def come_up(self) -> None:
        self.note("comes up")
        self.arbiter.line_up(self.now, paced=self.setup.paced)

    def mark(self) -> None:
        self.note("hears a damaged byte")
        self.arbiter.byte_marked(Mark.DAMAGED, self.now)
