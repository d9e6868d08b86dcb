"""What truly happened on an emulated line, against which a campaign holds what the master says happened.

Every value that a device sends is a number used once, and so is every value that is written: whichever comes to a
caller, the ledger knows who said it, to what, and when. A value is right only if the node and the element that were
asked said it after this very attempt had begun; a stale one is recognised although node and element are right.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import inf, nextafter
from typing import Any, Generic, NamedTuple, TypeVar

from busmaster.emulator.device import Device
from busmaster.emulator.line import Line, Talk
from busmaster.emulator.traceable import TraceableMemory

REMEMBERED = 2048
"""Answers and writes that are kept: far more than can still be on their way, and fewer than the narrowest protocol has
values."""
MANY = 2**30
REMEMBERED_OF_MANY = 16 * REMEMBERED
"""Likewise, where there are so `MANY` numbers. A read of MSC brings 32 at once, and what a slow poll brings is judged
when its cycle is over. A write of a program that shares the line may wait while 2048 others are sent."""
PICKY = 24
"""Numbers of which one is chosen where some are preferred, if there are enough."""
HEARD = 4096
ROUNDING = 1e-7
RECENT = 2.0
"""Seconds for which a frame that was damaged may still be in somebody's way."""


class Answer(NamedTuple):
    """A value was said for `element` of the device `node`, which heard the request at `asked`."""

    node: int
    element: int
    asked: float


class Frame(NamedTuple):
    """What a device said, whatever became of it on the line: caused by what it heard at `cause`."""

    cause: float
    start: float
    end: float
    data: bytes = b""


NOTHING = Frame(-inf, -inf, -inf)


class Damage(NamedTuple):
    """What passed then does not hold what was said."""

    start: float
    end: float


Passed = TypeVar("Passed", Frame, Damage)


class Latest(Generic[Passed]):
    """What passed last on a line. A search begins with the newest and seldom reaches the rest."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, Passed]] = deque(maxlen=REMEMBERED)
        """Each with the latest end of all up to it."""

    def add(self, passed: Passed) -> None:
        """Add what passed after all others, but may end before one of them."""
        before = self._kept[-1][0] if self._kept else -inf
        self._kept.append((max(before, passed.end), passed))

    def ending_after(self, time: float) -> Iterator[Passed]:
        """All that end after `time`, and perhaps others, the newest first."""
        for latest_end, passed in reversed(self._kept):
            if latest_end <= time:
                return
            yield passed


@dataclass(slots=True)
class Written:
    """A number that was sent to be written. `node` None: to all."""

    node: int | None
    elements: tuple[int, ...]
    order: int
    by: object = None
    """Whose write it is."""
    taken: int = 0
    taken_at: float = -inf


@dataclass(slots=True)
class Spoken:
    """What passed in one exchange: `heard` is what the host heard since its request, which takes until `asked_until`
    by the baud rate, be the line paced or not."""

    asked_at: float
    asked_until: float
    heard: bytearray = field(default_factory=bytearray)


@dataclass
class Ledger:
    """Of one line. `step`, prime to `modulus`, keeps numbers that were given out one after the other far apart, so
    that a damaged one does not look like its neighbour."""

    modulus: int
    step: int
    now: Callable[[], float] = lambda: 0.0
    problem: Callable[[str], None] = field(default=lambda what: None)
    unseen_writes: int = 0
    """Writes that were taken though nobody had sent them: damage that the request's checksum does not show."""
    gaps: bool = False
    """Devices miss what passes for a while: that is damage too."""
    unexpected: int = 0
    """What devices said that nobody had asked, because of damage: one that missed the end of a request takes the
    beginning of the next one for it; a Mentor II that missed the request to another takes that one's ACK for its own
    short command. Then R3's assumption does not hold for a while."""
    prefers: Callable[[int, int, int], bool] | None = None
    """Whether a number makes an answer that is likely to be mistaken: of node, element and number."""
    last: Frame = NOTHING
    """The latest of all that devices who were asked are going to say."""
    _asked: deque[tuple[object, Frame]] = field(default_factory=lambda: deque([(None, NOTHING)], maxlen=64))
    """Who was asked and is going to say what: the latest."""
    _given: int = 0
    _answers: dict[int, Answer] = field(default_factory=dict)
    _written: dict[int, Written] = field(default_factory=dict)
    _old: deque[int] = field(default_factory=deque)
    _old_writes: deque[tuple[int, Written]] = field(default_factory=deque)
    _frames: Latest[Frame] = field(default_factory=Latest)
    _damage: Latest[Damage] = field(default_factory=Latest)
    _unexpected_at: float = -inf
    _orders: dict[tuple[int, object], int] = field(default_factory=dict)

    @property
    def _remembered(self) -> int:
        return REMEMBERED if self.modulus < MANY else REMEMBERED_OF_MANY

    def number(self) -> int:
        """One that was not used for long."""
        return self._remember(self._next())

    def _next(self) -> int:
        self._given += 1
        return self._given * self.step % self.modulus

    def _remember(self, number: int) -> int:
        self._old.append(number)
        if len(self._old) > self._remembered:
            old = self._old.popleft()
            self._answers.pop(old, None)
        return number

    def said_for(self, number: int) -> Answer | None:
        return self._answers.get(number)

    def answer(self, node: int, element: int) -> int:
        number = self._next()
        if self.prefers is not None:
            for _ in range(min(PICKY, self.modulus // REMEMBERED // 4)):
                if self.prefers(node, element, number):
                    break
                number = self._next()
        self._remember(number)
        self._answers[number] = Answer(node, element, self.now())
        return number

    def sending(self, number: int, node: int | None, elements: tuple[int, ...], by: object = None) -> Written:
        """It is going to be written. Must be told in the order in which the writes are submitted.

        Writes are remembered longer than what was read: one of a program that asks much may wait for minutes.
        """
        written = self._written[number] = Written(node, elements, self._given, by)
        self._old_writes.append((number, written))
        if len(self._old_writes) > self._remembered:
            old, before = self._old_writes.popleft()
            if self._written.get(old) is before:  # a short number may have been used again
                del self._written[old]
        return written

    def take(self, node: int, element: int, number: int) -> None:
        """A device stores a number."""
        now = self.now()
        written = self._written.get(number)
        if written is None or written.node not in (None, node) or element not in written.elements:
            if self.gaps or self.damaged(now - RECENT, now):
                self.unseen_writes += 1
            else:
                self.problem(f"device {node} took {number} for {element}, which nobody sent it")
            return
        if element != written.elements[0]:
            return
        written.taken += 1
        written.taken_at = now
        if (
            written.node is not None and written.taken == 1
        ):  # a request that is received twice is not the master's order
            if written.order < self._orders.get((node, written.by), 0):
                self.problem(f"R7: device {node} took the write of {number} after a later one")
            self._orders[node, written.by] = written.order

    def said(self, start: float, end: float, asked: bool, talker: object = None, data: bytes = b"") -> None:
        """A device is going to say something; `asked`: the last request was for it."""
        now = self.now()
        frame = Frame(now, start, end, data)
        self._frames.add(frame)
        if asked:
            self._asked.append((talker, frame))
            self.last = max(self.last, frame, key=lambda one: one.end)
        elif self.gaps or self.damaged(now - RECENT, now):
            self.unexpected += 1
            self._unexpected_at = now
        else:
            self.problem("a device spoke that was not asked")

    def taken_back(self, talker: object, now: float) -> None:
        """A device has restarted: what it had not begun to say by now is not said."""
        kept = [(other, frame) for other, frame in self._asked if other is not talker or frame.start < now]
        self._asked = deque(kept, maxlen=self._asked.maxlen)
        self.last = max((frame for _, frame in kept), key=lambda one: one.end, default=NOTHING)

    def spoiled(self, start: float, end: float) -> None:
        """What passed then does not hold what was said."""
        self._damage.add(Damage(start, end))

    def damaged(self, begin: float, end: float) -> bool:
        """Something that passed in that time was not what was said."""
        return any(start <= end and begin < stop for start, stop in self._damage.ending_after(begin))

    def disguised(self, asked: float, now: float) -> bool:
        """Since the request at `asked`, an overdue reply has ended that noise had changed. Nothing can tell it from the
        reply to this request where the noise made it look like that."""
        return any(
            frame.cause < asked < frame.end
            and (
                (frame.end <= now and self.damaged(frame.start, frame.end))
                # Noise may have removed its last byte. On a line without pacing, a reply takes no time.
                or any(start == frame.start and asked < end <= now for start, end in self._damage.ending_after(asked))
            )
            for frame in self._frames.ending_after(asked)
        )

    def broken(self) -> bool:
        """A device spoke unexpected a short while ago."""
        return self.now() - self._unexpected_at < RECENT

    def overdue_replies(self, begin: float, end: float) -> Iterator[Frame]:
        """Replies to requests before `begin` that were still on the line in that time, and that noise did not change.

        Nothing can tell one that noise has changed from the reply to the present request, if it looks like that one.
        """
        for frame in self._frames.ending_after(begin):
            late = frame.cause < begin < frame.end - ROUNDING and frame.start < end
            if late and not self.damaged(frame.start, frame.end):
                yield frame


class LedgerMemory(TraceableMemory):
    """The memory of one device: it keeps no values, the ledger does."""

    def __init__(self, ledger: Ledger, node: int) -> None:
        super().__init__(node, ledger.modulus)
        self.ledger = ledger

    def read(self, element: int) -> int:
        return self.ledger.answer(self.node, element)

    def write(self, element: int, value: float, slack: int = 0) -> None:
        self.ledger.take(self.node, element, round(value))


class WatchedLine(Line):
    """A line whose ledger learns what is said on it, what of that is damaged, and what the host hears.

    `repeats`: its devices speak by themselves until they are acknowledged (MSC).
    """

    def __init__(self, ledger: Ledger, *args: Any, repeats: bool = False, **options: Any) -> None:
        super().__init__(*args, **options)
        self.ledger = ledger
        self.repeats = repeats
        self.record: Callable[[str], None] | None = None
        """Is told what devices say, and what becomes of it."""
        self.on_request: Callable[[float], None] = lambda now: None
        self._request = self._said = b""
        self._replied: list[Device] = []
        """The devices that have said something since the last request."""
        self._exchanges: deque[Spoken] = deque([Spoken(-inf, -inf)], maxlen=REMEMBERED)

    @property
    def asked_at(self) -> float:
        """When the latest exchange began."""
        return self._exchanges[-1].asked_at

    def send(self, data: bytes, now: float) -> None:
        if len(data) > 1:
            self.on_request(now)
            self._request = data
            self._exchanges.append(Spoken(now, now))
        self._replied.clear()  # one byte requests the next parameter of an exchange: the same node replies once more
        super().send(data, now)
        self._exchanges[-1].asked_until = now + len(data) * self.settings.byte_time

    def receive(self, now: float) -> bytes:
        data = super().receive(now)
        if data and len(self._exchanges[-1].heard) < HEARD:
            self._exchanges[-1].heard += data
        return data

    def held_back(self, now: float) -> bool:
        """Bytes that have passed are still to reach the host."""
        return bool(self._arrivals) and self._arrivals[-1][0] > now + ROUNDING

    def during(self, begin: float, end: float) -> Iterator[Spoken]:
        """What was said in that time, the latest first."""
        for spoken in reversed(self._exchanges):
            if spoken.asked_at < begin:
                return
            if spoken.asked_at < end:
                yield spoken

    def _transmit(self, talker: Device | None, start: float, data: bytes) -> None:
        if talker is not None:
            self.tell(talker, start, start + len(data) * self.tau, data)
        self.put(talker, start, data)

    def tell(self, talker: Device, start: float, end: float, data: bytes) -> None:
        """Have the ledger know what a device is going to say."""
        asked = self.repeats or self._request.startswith(talker.routes)
        if asked and not self.repeats:
            # noise can look like a request to a device that has replied already, and cause a second reply
            asked = talker not in self._replied or not self.ledger.damaged(start - RECENT, start)
            self._replied.append(talker)
        if self.record is not None:
            self.record(f"{self.ledger.now():.6f} {talker!r} says {data.hex(' ')} from {start:.6f} to {end:.6f}")
        self.ledger.said(start, end, asked, talker, data)

    def _take_back(self, talker: Device, now: float) -> None:
        super()._take_back(talker, now)
        self.ledger.taken_back(talker, now)

    def put(self, talker: Device | None, start: float, data: bytes) -> None:
        """Put it on the wire, with the faults that strike there."""
        self._said = data
        super()._transmit(talker, start, data)

    def _join(self, talk: Talk) -> None:
        if not talk.clean and self._said not in talk.data:
            self._spoiled(talk, f"passes as {talk.data.hex(' ')}")
        super()._join(talk)

    def _collide(self, talk: Talk, other: Talk) -> None:
        super()._collide(talk, other)
        self._spoiled(talk, "collides with another")

    def _spoiled(self, talk: Talk, what: str) -> None:
        # On a line without pacing a request takes no time, and its exchange begins at the same moment: it is damage to
        # that exchange. The reply before it, which ends then, is not.
        end = nextafter(talk.end, inf) if talk.talker is None else talk.end
        self.ledger.spoiled(talk.start, end)
        if self.record is not None:
            who = "the host's" if talk.talker is None else f"{talk.talker!r}'s"
            self.record(f"{self.ledger.now():.6f} {who} talk from {talk.start:.6f} to {talk.end:.6f} {what}")
