"""An output that is slow or down: what it holds is bounded, what is dropped is counted, nobody waits for it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from busmaster.app.outputs import batches
from busmaster.app.outputs.base import FIRST_RETRY, LAST_RETRY, Happening, Item, Output, Unsendable, reason
from busmaster.app.outputs.batches import BatchOutput
from busmaster.app.outputs.settings import SpillingSettings
from busmaster.app.service.record import WriteRecord
from busmaster.bus.polling import Snapshot
from tests.app.outputs.cycles import cycle, settled, until
from tests.app.outputs.test_audit import WRITE
from tests.patience import PATIENCE


class Shelf(BatchOutput[Item]):
    """Puts everything into a list, when it is let."""

    def __init__(self, buffer: int = 100, report: Callable[[str], None] = lambda _: None) -> None:
        super().__init__("shelf", SpillingSettings(buffer=buffer), report=report)
        self.shelf: list[Item] = []
        self.let = threading.Event()
        self.let.set()
        self.broken: Exception | None = None
        self.shuts = 0

    def format(self, item: Item) -> Item | None:
        return None if isinstance(item, Happening) else item

    def commit(self, batch: list[Item]) -> None:
        self.let.wait(PATIENCE)
        if self.broken is not None:
            raise self.broken
        self.shelf += batch

    def pack(self, formatted: Item) -> str:
        raise AssertionError("it has no spool")

    unpack = pack  # type: ignore[assignment]  # nor this

    def shut(self) -> None:
        self.shuts += 1

    @property
    def cycles(self) -> list[int]:
        return [item.cycle for item in self.shelf if isinstance(item, Snapshot)]


def offer(output: Output, first: int, last: int) -> None:
    for number in range(first, last + 1):
        output.offer(cycle(number, 1.0, 2.0))


def test_everything_is_written_in_order() -> None:
    output = Shelf()
    output.start()
    offer(output, 1, 20)
    output.close(PATIENCE)
    assert output.cycles == list(range(1, 21))
    assert output.statistics().written == 40


def test_a_batch_has_about_as_many_values_as_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH", 4)
    output = Shelf()
    commit, sizes = output.commit, list[int]()

    def committed(batch: list[Item]) -> None:
        sizes.append(len(batch))
        commit(batch)

    output.commit = committed  # type: ignore[method-assign]  # replaced here
    offer(output, 1, 5)
    output.start()
    output.close(PATIENCE)
    assert sizes == [2, 2, 1]  # cycles of two values


def test_one_that_is_stuck_drops_the_oldest_and_counts_what_it_drops() -> None:
    output = Shelf(buffer=10)
    output.let.clear()
    output.start()
    offer(output, 1, 1)
    until(lambda: not output._waiting)  # the thread has it, and is stuck
    offer(output, 2, 12)
    counts = output.statistics()
    assert (counts.dropped, counts.written, counts.waiting) == (14, 0, 10)
    output.let.set()
    output.close(PATIENCE)
    assert output.cycles == [1, 9, 10, 11, 12]
    counts = output.statistics()
    assert (counts.dropped, counts.written, counts.waiting) == (14, 10, 0)


def test_offering_never_waits_for_the_thread() -> None:
    output = Shelf(buffer=10)
    output.let.clear()
    output.start()
    offer(output, 1, 200)
    assert not output.shelf  # nothing could be written meanwhile
    output.let.set()
    output.close(PATIENCE)
    assert output.written + output.dropped == output.offered == 400


def test_what_failed_is_written_when_it_works_again_and_both_are_told() -> None:
    said: list[str] = []
    output = Shelf(report=said.append)
    output._retry = 0.01
    output.broken = OSError(28, "No space left on device", "/disk/x")
    output.start()
    offer(output, 1, 3)
    until(lambda: bool(said))
    assert output.statistics().error == "/disk/x: No space left on device"
    output.broken = None
    offer(output, 4, 5)
    until(lambda: settled(output))
    assert said == ["shelf is down: /disk/x: No space left on device", "shelf is up again"]
    output.close(PATIENCE)
    assert output.cycles == [1, 2, 3, 4, 5]
    assert output.statistics().error == ""


def test_one_that_is_down_keeps_the_newest_and_drops_also_what_it_has_tried_to_write() -> None:
    said: list[str] = []
    output = Shelf(buffer=10, report=said.append)
    output._retry = PATIENCE  # the next try is that of the end
    output.broken = OSError(28, "No space left on device", "/disk/x")
    offer(output, 1, 5)
    output.offer(Happening(0.0, "winder", "winder is down"))
    output.start()
    until(lambda: bool(said))
    offer(output, 6, 7)
    assert output.statistics().dropped == 4
    assert [item.cycle for item in output._waiting if isinstance(item, Snapshot)] == [3, 4, 5, 6, 7]
    output.broken = None
    output.close(PATIENCE)
    assert output.cycles == [3, 4, 5, 6, 7]
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.waiting) == (11, 4, 0), "the event, which it does not write, once"


def test_an_audit_entry_that_is_dropped_after_a_failed_try_is_reported_to_who_waits_for_it() -> None:
    said: list[str] = []
    kept: list[str] = []
    output = Shelf(buffer=2, report=said.append)
    output._retry = PATIENCE
    output.broken = OSError("broken")
    output.offer_entry(WRITE, kept.append)
    output.start()
    until(lambda: bool(said))
    assert not kept
    offer(output, 1, 1)
    assert kept == ["shelf dropped it, because its queue was full"]
    output.broken = None
    output.close(PATIENCE)
    assert (output.shelf, output.cycles, len(kept)) == (output.shelf[-1:], [1], 1)


def test_a_bug_in_an_output_does_not_end_it() -> None:
    output = Shelf()
    output._retry = 0.01
    output.broken = ZeroDivisionError("division by zero")
    output.start()
    offer(output, 1, 1)
    until(lambda: output.statistics().error == "division by zero")
    output.broken = None
    until(lambda: settled(output))
    output.close(PATIENCE)
    assert output.cycles == [1]


def test_what_is_left_when_it_is_closed_is_counted_as_dropped() -> None:
    said: list[str] = []
    output = Shelf(report=said.append)
    output.broken = OSError("gone")
    output.start()
    offer(output, 1, 5)
    output.close(PATIENCE)
    assert (output.written, output.dropped) == (0, 10)
    assert said == ["shelf is down: gone"]


def test_one_that_hangs_is_not_waited_for() -> None:
    said: list[str] = []
    output = Shelf(report=said.append)
    output.let.clear()
    output.start()
    offer(output, 1, 1)
    until(lambda: not output._waiting)
    output.close(0.01)
    assert output._thread.is_alive()
    assert output.dropped == 2
    assert said == ["shelf did not end within 0.01 s: 2 values count as dropped, and may still be written"]
    output.close(0.01)
    assert len(said) == 1, "there are no further values"
    output.let.set()
    assert output._thread.daemon, "or it would keep the process from ending"


HANGING = """
import sys
from busmaster.app.outputs.base import Happening
from busmaster.app.outputs.files import JsonlOutput
from busmaster.app.outputs.settings import FileSettings

output = JsonlOutput("jsonl", FileSettings(path=sys.argv[1]))
output.start()
output.offer(Happening(0.0, "winder", "winder is down"))
output.close(0.01)
print(output.statistics().dropped, "dropped")
"""
"""A program whose output opens a pipe that nobody reads: that waits for a reader."""


@pytest.mark.slow
def test_one_that_hangs_does_not_keep_its_process_from_ending(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    program = [sys.executable, "-c", HANGING, str(tmp_path / "pipe")]
    assert subprocess.run(program, check=True, capture_output=True, timeout=PATIENCE).stdout == b"1 dropped\n"


def test_what_an_output_does_not_write_is_no_loss_and_what_was_lost_before_it_is() -> None:
    output = Shelf()
    output.start()
    output.offer(Happening(0.0, "winder", "winder is down"))
    output.miss(3)
    output.close(PATIENCE)
    assert (output.written, output.dropped, output.offered) == (1, 3, 4)


def test_one_that_is_reopened_lets_go_of_what_it_had_open_and_goes_on() -> None:
    output = Shelf()
    output.start()
    offer(output, 1, 3)
    until(lambda: settled(output))
    output.reopen()
    until(lambda: output.shuts == 1)
    offer(output, 4, 5)
    output.close(PATIENCE)
    assert output.cycles == [1, 2, 3, 4, 5]
    assert output.shuts == 2


def test_what_was_lost_before_it_could_be_offered_counts_as_dropped() -> None:
    output = Shelf()
    output.start()
    output.miss(3)
    offer(output, 1, 1)
    output.close(PATIENCE)
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.waiting) == (2, 3, 0)


class Picky(Output):
    """Sends each cycle, except the one that can never be sent."""

    def __init__(self, report: Callable[[str], None]) -> None:
        super().__init__("picky", SpillingSettings(), report)
        self.sent: list[int] = []

    def work(self) -> None:
        self.drain(self._send)

    def _send(self, item: Item) -> None:
        assert isinstance(item, Snapshot)
        if item.cycle in (2, 3):
            raise Unsendable("the packet is too large")
        self.sent.append(item.cycle)


def test_an_item_that_can_never_be_sent_is_dropped_counted_and_reported_once() -> None:
    reported: list[str] = []
    output = Picky(reported.append)
    output.start()
    offer(output, 1, 5)
    output.close(PATIENCE)
    assert output.sent == [1, 4, 5]
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.waiting, counts.error) == (6, 4, 0, "")
    assert reported == ["picky dropped values that it cannot send: the packet is too large"]


class Sender(Output):
    """Sends items one by one, with the errors that a test wants."""

    def __init__(self, *errors: tuple[int, Exception], report: Callable[[str], None] = lambda _: None) -> None:
        """`errors`: what sending the cycle of that number raises, once each."""
        super().__init__("sender", SpillingSettings(), report)
        self._retry = 0.01
        self._errors = list(errors)
        self.sent: list[int] = []

    def work(self) -> None:
        self.drain(self._send)

    def _send(self, item: Item) -> None:
        if isinstance(item, WriteRecord):
            raise Unsendable("the entry is too large")
        assert isinstance(item, Snapshot)
        for number, (cycle_number, error) in enumerate(self._errors):
            if cycle_number == item.cycle:
                del self._errors[number]
                raise error
        self.sent.append(item.cycle)


def test_an_item_that_could_not_be_sent_is_sent_before_those_that_came_later() -> None:
    output = Sender((2, OSError("gone")))
    offer(output, 1, 4)
    output.start()
    until(lambda: settled(output))
    output.close(PATIENCE)
    assert output.sent == [1, 2, 3, 4]
    assert output.written == 8


def test_each_reason_for_which_items_are_dropped_is_reported_and_an_entry_learns_it() -> None:
    reported: list[str] = []
    why_not: list[str] = []
    output = Sender((1, Unsendable("too large")), (2, Unsendable("too old")), report=reported.append)
    offer(output, 1, 3)
    output.offer_entry(WRITE, why_not.append)
    output.start()
    until(lambda: len(reported) == 3)
    counts = output.statistics()
    assert (counts.dropped, counts.waiting) == (5, 0)
    output.close(PATIENCE)
    assert output.sent == [3]
    assert reported == [
        f"sender dropped values that it cannot send: {why}"
        for why in ("too large", "too old", "the entry is too large")
    ]
    assert why_not == ["sender dropped it: the entry is too large"]
    assert output.statistics().dropped == 5


def test_an_output_that_replaces_another_continues_all_of_its_counts() -> None:
    before = Sender((1, Unsendable("too large")))
    offer(before, 1, 3)
    before.miss(3)
    before.suppress(7)
    before.start()
    before.close(PATIENCE)
    after = Sender()
    after.succeed(before)
    counts = after.statistics()
    assert counts == before.statistics()
    assert (counts.written, counts.dropped, counts.suppressed, counts.waiting) == (4, 5, 7, 0)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (OSError(28, "No space left on device", "/disk/x"), "/disk/x: No space left on device"),
        (RuntimeError("[Errno 111] Connection refused"), "Connection refused"),
        (ValueError("two\n  lines"), "two lines"),
        (TimeoutError(), "TimeoutError"),
        (ExceptionGroup("a", [ExceptionGroup("b", [OSError(28, "No space")]), ValueError("c")]), "No space"),
    ],
)
def test_the_reason_why_an_output_is_down_is_one_line_without_numbers(error: Exception, text: str) -> None:
    assert reason(error) == text


def test_another_reason_is_reported_while_an_output_is_down_and_the_same_one_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(batches, "TICK", 0.001)
    said: list[str] = []
    tries: list[float] = []
    output = Shelf(report=said.append)
    output._destination = "/disk/x"

    def rest(seconds: float) -> None:
        tries.append(seconds)

    output.rest = rest  # type: ignore[method-assign]  # replaced here
    output.broken = OSError("full")
    offer(output, 1, 1)
    output.start()
    until(lambda: len(tries) > 2)
    output.broken = OSError("/disk/x is gone")
    until(lambda: len(said) > 1)
    output.broken = None
    until(lambda: settled(output))
    output.close(PATIENCE)
    assert said == [
        "shelf is down: /disk/x: full",
        "shelf is down: /disk/x is gone",  # it names its destination once
        "shelf is up again",
    ]


def test_pauses_between_tries_are_doubled_up_to_a_bound_and_short_again_after_a_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(batches, "TICK", 0.001)
    pauses: list[float] = []
    output = Shelf()

    def rest(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) in (7, 8):
            output.broken = None

    output.rest = rest  # type: ignore[method-assign]  # replaced here
    output.broken = OSError("gone")
    offer(output, 1, 1)
    output.start()
    until(lambda: settled(output))
    assert (pauses[0], pauses[-1]) == (FIRST_RETRY, LAST_RETRY)
    assert pauses == [0.5, 1, 2, 4, 8, 10, 10]
    output.broken = OSError("gone")
    offer(output, 2, 2)
    until(lambda: settled(output))
    output.close(PATIENCE)
    assert pauses[7:] == [FIRST_RETRY]


def test_an_output_that_is_ended_while_a_try_fails_tries_once_more() -> None:
    output = Shelf()
    output.let.clear()
    output.broken = OSError("gone")

    def shut() -> None:
        output.broken = None

    output.shut = shut  # type: ignore[method-assign]  # replaced here
    output.start()
    offer(output, 1, 1)
    until(lambda: not output._waiting)  # the thread has it, and is stuck
    output._stop.set()
    output.let.set()
    output.close(PATIENCE)
    assert output.cycles == [1]
