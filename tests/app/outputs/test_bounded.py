"""An output that is slow or down: what it holds is bounded, what is dropped is counted, nobody waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable

from busmaster.app.outputs.base import Happening, Item, Output, Unsendable
from busmaster.app.outputs.batches import BatchOutput
from busmaster.app.outputs.settings import SpillingSettings
from busmaster.bus.polling import Snapshot
from tests.app.outputs.cycles import cycle, settled, until
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
    output = Shelf()
    output.broken = OSError("gone")
    output.start()
    offer(output, 1, 5)
    output.close(PATIENCE)
    assert (output.written, output.dropped) == (0, 10)


def test_one_that_hangs_is_not_waited_for() -> None:
    output = Shelf()
    output.let.clear()
    output.start()
    offer(output, 1, 1)
    until(lambda: not output._waiting)
    output.close(0.01)
    assert output._thread.is_alive()
    assert output.dropped == 2
    output.let.set()


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
