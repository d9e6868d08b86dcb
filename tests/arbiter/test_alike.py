"""How long a run of answers alike may go on: what times show of one reply too many, and what they hide (R15)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count, pairwise
from random import Random

import pytest

from busmaster.arbiter.choice import LONGEST_STEADY, Alike
from busmaster.arbiter.transaction import Transaction
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import TAU, Bench, reply_of, up
from tests.tiers import one_by_default

REQUEST = 8 * TAU
MOST_ALIKE = 32
Draw = Callable[[], float]


def steady(seconds: float, spread: float = 0.0, seed: int = 1) -> Draw:
    chance = Random(seed)
    return lambda: seconds + chance.uniform(-spread, spread)


class Saturated:
    """A saturated line of equal reads, on four wires: replies come while a request is sent. Every value is the number
    of its request. `delays` are the nodes', which think of one request at a time where they are `patient`, and
    else of each as it comes. The reply of that number is said `twice`, so many seconds after it was said first. What
    has come is seen only after `stalls`."""

    def __init__(
        self,
        delays: Sequence[Draw],
        *,
        patient: bool = True,
        twice: tuple[int, float] | None = None,
        paced: bool = True,
        stalls: Draw = lambda: 0.0,
    ) -> None:
        self.bench = Bench(paced=paced)
        self.nodes = [up(self.bench, address) for address in range(1, len(delays) + 1)]
        for node in self.nodes:
            node.usual = None
        self.bench.wait(0.2)
        self.delays = delays
        self.patient = patient
        self.twice = twice
        self.stalls = stalls
        self.free = [0.0] * len(delays)
        self.quiet = 0.0
        self.coming: list[tuple[float, str]] = []
        self.waiting: list[Transaction] = []
        self.right = 0
        self.wrong: list[int] = []
        """The numbers of the requests whose values are another's."""
        self.unlike: list[int] = []
        """The numbers of the requests that were checks."""

    def run(self, requests: int) -> Saturated:
        bench = self.bench
        number = asked = 0
        while number < requests:
            while len(self.waiting) < 3:
                self.waiting.append(bench.ask(self.nodes[asked % len(self.nodes)]))
                asked += 1
            if request := bench.sent():
                number += 1
                if bytes.fromhex(request)[4:6] != b"01":
                    self.unlike.append(number)
                self._answer(bytes.fromhex(request), number)
            due, data = min(self.coming, default=(float("inf"), ""))
            if due <= bench.arbiter.poll_timeout():
                self.coming.remove((due, data))
                bench.hear(data, after=max(0.0, due + self.stalls() - bench.now))
            else:
                bench.to(bench.arbiter.poll_timeout())
            for read in [read for read in self.waiting if bench.ended(read)]:
                self.waiting.remove(read)
                if read.value == number:
                    self.right += 1
                elif read.value is not None:
                    self.wrong.append(number)
        return self

    def _answer(self, request: bytes, number: int) -> None:
        place = int(request[1:3], 16) - 1
        data = reply_of(int(request[4:6], 16), number)
        heard = self.bench.now + REQUEST
        start = (max(heard, self.free[place]) if self.patient else heard) + self.delays[place]()
        self.free[place] = self._say(data, start)
        if self.twice is not None and self.twice[0] == number:
            self.free[place] = self._say(data, self.free[place] + self.twice[1])

    def _say(self, data: str, start: float) -> float:
        self.quiet = max(self.quiet, start) + len(data.split()) * TAU
        self.coming.append((self.quiet, data))
        return self.quiet

    @property
    def sync_reads(self) -> int:
        return self.bench.arbiter.statistics(self.bench.now).sync_reads


KINDS = {
    "one": [steady(0.002)],
    "one, uneven": [steady(0.002, 0.0003)],
    "eight": [steady(0.002, 0.0002, seed) for seed in range(8)],
    "slow and fast": [steady(0.002 + 0.001 * place, 0.0002, place) for place in range(8)],
    "one slow": [steady(0.020 if place == 3 else 0.002) for place in range(8)],
    "erratic": [steady(0.004, 0.002, seed) for seed in range(3)],
}


STEADY = [kind for kind in KINDS if kind != "erratic"]
PATIENCE = pytest.mark.parametrize("patient", [False, True], ids=["each as it comes", "one at a time"])


@pytest.mark.parametrize("kind", STEADY)
def test_a_steady_line_is_checked_after_128_answers_alike(kind: str) -> None:
    line = Saturated(KINDS[kind]).run(3 * LONGEST_STEADY)
    assert line.wrong == []
    assert line.sync_reads <= 4, "the first one is sooner: no node's usual time is known yet"


def test_a_steady_line_is_checked_at_every_128th_answer() -> None:
    unlike = Saturated(KINDS["one"]).run(5 * LONGEST_STEADY).unlike
    assert [later - earlier for earlier, later in pairwise(unlike[1:])] == [128, 128]


def test_a_line_whose_answers_vary_by_more_than_half_a_request_is_checked_after_32() -> None:
    line = Saturated(KINDS["erratic"]).run(3 * LONGEST_STEADY)
    assert line.sync_reads >= 3 * LONGEST_STEADY // MOST_ALIKE - 1


def test_a_port_whose_bytes_do_not_leave_at_the_baud_rate_is_checked_after_32() -> None:
    line = Saturated(KINDS["one"], paced=False).run(3 * LONGEST_STEADY)
    assert line.sync_reads >= 3 * LONGEST_STEADY // MOST_ALIKE - 1


@PATIENCE
@pytest.mark.parametrize("kind", one_by_default(KINDS))
def test_r15_of_one_doubled_reply_on_a_line_of_equal_reads_at_most_32_values_are_wrong(
    kind: str, patient: bool
) -> None:
    """Whatever its delays, whenever it comes: also where no check would be due for long."""
    worst = []
    for number in (3, 60, 130, 140):
        for gap in (0.0001, 0.0009, 0.0025, 0.007):
            line = Saturated(KINDS[kind], patient=patient, twice=(number, gap)).run(number + 2 * MOST_ALIKE)
            worst.append(len(line.wrong))
    assert 1 < max(worst) <= MOST_ALIKE, "the line got out of step, and was found out"


@PATIENCE
def test_r15_a_process_that_stands_still_hides_what_times_show_no_longer_than_it_does(patient: bool) -> None:
    """One answer in five is seen late, as one that is slow would be: those behind it come too soon all the same."""
    chance = Random(5)
    for number in (60, 130, 140):
        line = Saturated(
            KINDS["one"],
            patient=patient,
            twice=(number, 0.0009),
            stalls=lambda: chance.uniform(0.0005, 0.0015) if chance.random() < 0.2 else 0.0,
        ).run(number + 2 * MOST_ALIKE)
        assert len(line.wrong) <= MOST_ALIKE


def test_r15_a_node_that_has_just_become_slower_is_checked_before_its_times_are_believed() -> None:
    """What would be sooner than its new time is no sooner than its old one."""
    answers = count()
    line = Saturated([lambda: 0.002 if next(answers) < 40 else 0.0035], twice=(43, 0.0009))
    assert len(line.run(43 + 2 * MOST_ALIKE).wrong) <= MOST_ALIKE


def test_r15_a_line_that_was_steady_is_found_out_at_once() -> None:
    line = Saturated(KINDS["one"], twice=(70, 0.0009)).run(200)
    assert 0 < len(line.wrong) <= 3


def test_a_byte_from_before_the_request_says_nothing_of_the_time_that_a_node_usually_takes() -> None:
    bench = Bench(paced=True)
    node = up(bench)
    node.usual = None
    alike = Alike(bench.arbiter._wire)
    alike.node = node
    bench.arbiter._step.end = 1.0
    assert not alike.another(hcp2.Read(1).open(1, hcp2.PROFILE.timings), 0.99, 1.0)
    assert node.usual is None


def test_a_pause_in_which_an_answer_too_many_would_have_come_begins_the_count_anew() -> None:
    bench = Bench()
    alike = Alike(bench.arbiter._wire)
    alike.count = 7
    assert not alike.another(hcp2.Read(1).open(1, hcp2.PROFILE.timings), 0.0, 1.0)
    assert alike.count == 0
