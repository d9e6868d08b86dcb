"""The base of all outputs: an output is offered the values and events of a line, and handles them in its own thread.

Theory of operation. `offer` runs on the loop that owns the line: it appends to a queue and returns. The thread checks
the queue every TICK, so that the line never wakes it. It takes the items piece by piece, and releases the interpreter
after each piece. The queue is bounded: if the output does not work, the oldest items are dropped.

Each count has one writer, the loop or the thread, so that they are exact without a lock:
`offered` + `found` = `written` + `dropped` + `lost` + `spilled` + number of values in memory.
"""

from __future__ import annotations

import importlib.util
import os
import re
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeAlias

from busmaster import Bus, InvalidCommand, Point, Snapshot
from busmaster.app.outputs.settings import Settings
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.record import WriteRecord

TICK = 0.05
PAUSE = 0.0002
"""Seconds for which the thread lets go of the interpreter after each cycle that it has formatted."""
BATCH = 2_000
"""Values that are written at once."""
FIRST_RETRY, LAST_RETRY = 0.5, 10.0
"""Seconds from a failure to the next try: doubled each time."""
ERROR_NUMBER = re.compile(r"^\[Errno -?\d+\] ")


class Happening(NamedTuple):
    """An event, as a sentence. `node` is its label, "" for the line as a whole; `time` is in seconds since 1970."""

    time: float
    node: str
    text: str


Item: TypeAlias = Snapshot | Happening | WriteRecord
Kept: TypeAlias = Callable[[str], object]


def size_of(item: Item) -> int:
    """Return how many values an item holds; an event, or a write, counts as one."""
    return len(item.samples) if isinstance(item, Snapshot) else 1


@dataclass(frozen=True, slots=True)
class OutputStatistics:
    """Counts of values and events; of answers where it only answers (`what`: "answered").

    `error` is why it is down, "" while it is not. `spilled` is how many of those that wait do so on disk, where they
    survive the end of the process. `suppressed` counts the values that were not news by the meaning of their points:
    they were never to be written.
    """

    kind: str
    what: str
    written: int
    dropped: int
    waiting: int
    error: str
    spilled: int = 0
    suppressed: int = 0


def reason(error: BaseException) -> str:
    """Return on one line what went wrong."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(ERROR_NUMBER.sub("", text).split()) or type(error).__name__


def check_folder(path: str) -> None:
    """Raise InvalidCommand if the folder of a file does not exist, so that the error is reported at the start.

    Folders whose names contain fields of a date are created later.
    """
    folder = os.path.dirname(path)
    while "%" in folder:
        folder = os.path.dirname(folder)
    if folder and not os.path.isdir(folder):
        raise InvalidCommand(f"{path}: the folder {folder} does not exist; create it, or use another path")


def check_extra(package: str, extra: str) -> None:
    """Raise InvalidCommand with the installation command if the package of an extra is missing."""
    if importlib.util.find_spec(package) is None:
        raise InvalidCommand(f"this output needs {package}, which is not installed; pip install 'busmaster[{extra}]'")


class Unsendable(Exception):
    """An item that can never be sent, raised in the `send` of `Output.drain` with the reason. The item is dropped."""


class Output(ABC):
    """One output. `report` is called from any thread with what happens to the output."""

    what: ClassVar[str] = "written"
    finds_outdated: ClassVar[bool] = False
    """It finds out by itself which values a write has made stale."""

    def __init__(
        self,
        kind: str,
        settings: Settings,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.kind = kind
        self.groups = settings.groups
        self._destination = settings.destination
        self.error = ""
        self.offered = self.dropped = self.written = 0
        self.suppressed = 0
        self.spilled = self.lost = 0
        """Values that wait on disk, and those that the thread had to drop from there."""
        self.found = 0
        """Values that were on disk when it began: of an earlier process, or of the output that this one replaces."""
        self._capacity = settings.buffer
        self.is_strict = getattr(settings, "audit", "") == "strict"
        """Whether a write is acknowledged only after this output has made its audit entry durable."""
        self._promised: dict[int, tuple[WriteRecord, Kept]] = {}
        """Audit entries whose durability is awaited, by their identity: loop and thread share it without a lock."""
        self._report = report
        self._waiting: deque[Item] = deque()  # loop and thread share it without a lock: its operations are atomic
        self._stop = threading.Event()
        self._reopen = threading.Event()
        self._retry = FIRST_RETRY
        self._unsendable = ""
        # A daemon: one that hangs on a disk or a network must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name=f"busmaster {kind}", daemon=True)

    # on the loop that owns the line

    def start(self) -> None:
        """Start the output's thread."""
        self._thread.start()

    def offer(self, item: Item) -> None:
        """Hand it an item without ever waiting. The oldest are dropped where the output does not keep up."""
        self._waiting.append(item)
        self.offered += size_of(item)
        while self._left() - self.spilled > self._capacity:
            try:
                oldest = self._waiting.popleft()
            except IndexError:
                break  # the rest is in the thread's hands until its try ends
            self.dropped += size_of(oldest)
            if isinstance(oldest, WriteRecord):
                self.settle_entry(oldest, f"{self.kind} dropped it, because its queue was full")

    def offer_entry(self, entry: WriteRecord, kept: Kept) -> None:
        """Offer an audit entry. `kept` is called once, from any thread: with "" when the entry is durable, and with
        the reason when it never will be."""
        self._promised[id(entry)] = entry, kept
        self.offer(entry)

    def settle_entry(self, entry: WriteRecord, why_not: str = "") -> None:
        """Call the `kept` of an audit entry: it is durable, or never will be for the given reason."""
        _, kept = self._promised.pop(id(entry), (None, None))
        if kept is not None:
            kept(why_not)

    def miss(self, values: int) -> None:
        """Count values as lost before they could be offered."""
        self.offered += values
        self.dropped += values

    def suppress(self, values: int) -> None:
        """Count values that are not offered because they are unchanged."""
        self.suppressed += values

    def reopen(self) -> None:
        """Close the file that is open, if there is one, and open it again: it may have been moved away."""
        self._reopen.set()

    def succeed(self, before: Output) -> None:
        """Count on from the output that this one replaces, which is closed. Call this before the new one is started.

        What waits on disk is not counted on: it is found there.
        """
        self.offered += before.offered + before.found - before.spilled
        self.dropped += before.dropped
        self.written += before.written
        self.suppressed += before.suppressed
        self.lost += before.lost

    def statistics(self) -> OutputStatistics:
        """Return the counts of this output, and why it is down."""
        dropped = self.dropped + self.lost
        return OutputStatistics(
            self.kind, self.what, self.written, dropped, self._left(), self.error, self.spilled, self.suppressed
        )

    def _left(self) -> int:
        """Return how many values wait, in memory and on disk."""
        return self.offered + self.found - self.written - self.dropped - self.lost

    # off the loop

    def close_interface(self) -> None:  # noqa: B027  nothing to do where there is no interface
        """Stop accepting input, and reply to the input received so far. Most outputs have no input."""

    def close(self, within: float) -> None:
        """Write the queue for at most `within` seconds, and drop the rest that is not on disk.

        Nothing must be offered any more.
        """
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(within)
        left = self._left() - self.spilled
        if left and self._thread.is_alive():
            self._report(
                f"{self.kind} did not end within {within:g} s: {left} values count as dropped, and may still be written"
            )
        self.dropped += left
        for entry, _ in list(self._promised.values()):
            self.settle_entry(entry, f"{self.kind} ended before it was written")

    # on the thread

    @abstractmethod
    def work(self) -> None:
        """Handle offered items until the output is stopped, then the rest. It is called again, later, if it raises."""

    def take(self) -> Item | None:
        """Take the oldest item that waits; None if none does."""
        try:
            return self._waiting.popleft()
        except IndexError:
            return None

    def wait_again(self, items: Sequence[Item]) -> None:
        """Put items back in front of the queue, in their order: if it fills up, they are dropped first."""
        self._waiting.extendleft(reversed(items))

    def put_back(self) -> None:  # noqa: B027  nothing to do where no item is in hand between two tries
        """Have items that could not be delivered wait again. It is called after each failed try."""

    def drain(self, send: Callable[[Item], None]) -> None:
        """Send items one by one until the output is stopped and none waits.

        If `send` raises Unsendable, the item is dropped. If it raises another error, the item waits again, in front of
        the others, and the error is raised on.
        """
        while True:
            stopped = self._stop.is_set()  # before the queue is checked: everything offered until then is sent
            item = self.take()
            if item is None:
                if stopped:
                    return
                self._stop.wait(TICK)
                continue
            try:
                send(item)
            except Unsendable as error:
                self._drop(item, str(error))
                continue
            except BaseException:
                self.wait_again([item])
                raise
            self.written += size_of(item)
            self.up()

    def _drop(self, item: Item, why: str) -> None:
        self.lost += size_of(item)
        if isinstance(item, WriteRecord):
            self.settle_entry(item, f"{self.kind} dropped it: {why}")
        if why != self._unsendable:  # the same reason is reported once
            self._unsendable = why
            self._report(f"{self.kind} dropped values that it cannot send: {why}")

    def up(self) -> None:
        """Note that the output works, and report it if it was down."""
        self._retry = FIRST_RETRY
        if self.error:
            self.error = ""
            self._report(f"{self.kind} is up again")

    def down(self, error: BaseException) -> None:
        """Note why the output does not work, and report the reason if it is a new one."""
        text = reason(error)
        if self._destination not in text:  # most errors of a library name neither a file nor a host
            text = f"{self._destination}: {text}"
        if text != self.error:
            self.error = text
            self._report(f"{self.kind} is down: {text}")

    def rest(self, seconds: float) -> None:
        """Wait for the next try, or until it is stopped."""
        self._stop.wait(seconds)

    def _run(self) -> None:
        """Work until stopped. Every error is reported, and the work is tried again: it must not end the thread."""
        while True:
            last = self._stop.is_set()  # before the try: one that is stopped in the midst of a failing try gets another
            try:
                self.work()
                return
            except Exception as error:
                self.put_back()
                self.down(error)
            if last:
                return
            self.rest(self._retry)
            self._retry = min(2 * self._retry, LAST_RETRY)


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputLine:
    """The line that an output belongs to. An output uses as much of it as it needs.

    `report` is called with an event of the output, from any thread. `commands` are the points, by their keys, that
    the output may write for others, through `authorisation`. `statistics` returns the counts of all outputs of the
    line. An output whose process is not `in_charge` of the line must not report the line's state. Where the process
    only listens, `polls` is False.
    """

    bus: Bus
    authorisation: Authorisation
    report: Callable[[str], None] = lambda _: None
    commands: Mapping[str, Point[Any]]
    statistics: Callable[[], Sequence[OutputStatistics]] = tuple
    in_charge: bool = True
    polls: bool = True


class Unsuitable(NamedTuple):
    """Why an output cannot take a group, and the key of the output's table at which that is reported."""

    why: str
    key: str | None = None


def takes_all(settings: Any, group: str, points: Mapping[str, str]) -> None:
    """Accept every group."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputKind:
    """A kind of output: the table `[outputs.NAME]` of a LINE.toml enables one.

    `settings` declares the keys of the table, and `make` makes the output of them. `about` is the sentence of the
    reference page. `keeps_audit`: commands that only write, and poll nothing, give their audit entries to it. `without`
    names keys of `settings` that this kind does not have. `unsuitable` returns why the output cannot take a group,
    given the sorts of its points by their keys, or None.
    """

    name: str
    settings: type[Settings]
    make: Callable[[Any, OutputLine], Output]
    about: str
    keeps_audit: bool = False
    without: tuple[str, ...] = ()
    unsuitable: Callable[[Any, str, Mapping[str, str]], Unsuitable | None] = takes_all


__all__ = [
    "Happening",
    "Item",
    "Output",
    "OutputKind",
    "OutputLine",
    "Unsendable",
    "Unsuitable",
    "check_extra",
    "takes_all",
]
