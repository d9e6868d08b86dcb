"""Dead nodes at 57600 baud with a 100 ms window: what the living keep, and how the dead return (R11)."""

from __future__ import annotations

from math import inf

import pytest

from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import BUDGET_SHARE, PROBE_JITTER, Health
from busmaster.arbiter.transaction import Transaction
from busmaster.protocols.hcp2 import codec as hcp2
from tests.tiers import one_by_default
from tests.verification.campaigns.loads import EXCHANGE, Load

SATURATED = 0.03
"""Eight nodes polled every 30 ms ask for 127 % of the line."""
EASY = 0.06
PROBE = 0.150


def polled(nodes: int, *, alive: int | None = None, period: float = SATURATED, seed: int = 1) -> Load:
    """Each node in a group of its own; only the last `alive` of them if that is given."""
    load = Load(nodes, seed=seed, spread=0.3)
    for node in load.nodes[0 if alive is None else nodes - alive :]:
        load.poll(str(node.address), period, [node])
    return load


def kill(load: Load, count: int) -> None:
    for address in range(1, count + 1):
        load.devices[address].faults.dead = 1.0


def revive(load: Load, count: int) -> None:
    for address in range(1, count + 1):
        load.devices[address].faults.dead = 0.0


def returns(load: Load, count: int, within: float) -> list[float]:
    """Seconds until each of the first nodes was polled again, sorted."""
    start = load.now
    load.run(within)
    cycles = [load.cycles[str(address)] for address in range(1, count + 1)]
    return sorted(min((begun for _, begun, _ in c if begun > start), default=inf) - start for c in cycles)


@pytest.mark.parametrize("seed", one_by_default([1, 2]))
@pytest.mark.parametrize("period", [SATURATED, EASY])
@pytest.mark.parametrize("dead", [1, 3])
@pytest.mark.parametrize("seconds", one_by_default([5.0, 30.0]))
def test_r11_the_living_keep_95_percent_of_their_rate_from_5_s_after_a_death(
    dead: int, period: float, seconds: float, seed: int
) -> None:
    living = range(dead + 1, 9)
    alone = polled(8, alive=8 - dead, period=period, seed=seed)
    alone.run(10.0)
    load = polled(8, period=period, seed=seed)
    load.run(5.0)
    kill(load, dead)
    load.run(5.0)
    assert [node.health for node in load.nodes[:dead]] == [Health.DOWN] * dead
    assert load.rate(seconds, living) >= 0.95 * alone.rate(seconds, living)


@pytest.mark.parametrize("dead", [1, 3])
@pytest.mark.parametrize("down_for", one_by_default([3.0, 20.0, 100.0]))
def test_r11_a_node_that_returns_is_polled_again_within_its_probe_delay(dead: int, down_for: float) -> None:
    """On a saturated line, where the budget is 2 %, or as soon as that pays for a probe of each dead node."""
    load = polled(8)
    load.run(5.0)
    kill(load, dead)
    load.run(down_for)
    delay = max(node.probe_delay for node in load.nodes[:dead]) * (1 + PROBE_JITTER)
    affordable = dead * PROBE / BUDGET_SHARE
    revive(load, dead)
    assert returns(load, dead, 60.0)[-1] <= max(delay, affordable) + PROBE + SATURATED


def test_r11_the_hook_of_a_node_that_returns_runs_before_its_polls() -> None:
    load = polled(8)
    node = load.nodes[0]
    node.has_hook = True
    order: list[str] = []

    def restore(change: NodeChanged) -> None:
        """What the bus does: parameters are sent again, then the node is released."""
        if change.returning:
            order.append("returned")
            load.ask(node, hcp2.Write(7, (1.0,)), tag=node)

    def release(transaction: Transaction) -> None:
        if transaction.tag is node:
            order.append("written")
            load.world.arbiter.dispatcher.release_node(node)

    load.on_change = restore
    load.on_completed = release
    load.run(5.0)
    kill(load, 1)
    load.run(10.0)
    good = load.good[1]
    revive(load, 1)
    while load.good[1] == good and load.now < 60.0:
        load.run(0.01)
        assert load.good[1] == good or order == ["returned", "written"]
    assert load.good[1] > good
    assert order == ["returned", "written"]


@pytest.mark.parametrize("seed", one_by_default([1, 2, 3]))
@pytest.mark.parametrize("after", one_by_default([5.0, 60.0]))
def test_r11_thirty_dead_of_forty_at_70_percent_load_all_return_soon(seed: int, after: float) -> None:
    load = polled(40, period=40 * EXCHANGE / 0.7, seed=seed)
    load.run(5.0)
    kill(load, 30)
    load.run(after)
    revive(load, 30)
    back = returns(load, 30, 40.0)
    assert back[15] <= 15.0
    assert back[-1] <= 30.0


@pytest.mark.slow
def test_r11_thirty_dead_of_forty_beside_ten_that_need_70_percent_all_return_soon() -> None:
    load = Load(40, spread=0.3)
    for node in load.nodes:
        load.poll(str(node.address), 40 * EXCHANGE if node.address <= 30 else 10 * EXCHANGE / 0.7, [node])
    load.run(5.0)
    kill(load, 30)
    load.run(60.0)
    revive(load, 30)
    back = returns(load, 30, 40.0)
    assert back[15] <= 15.0
    assert back[-1] <= 30.0


def test_r11_a_line_that_starts_with_thirty_dead_of_forty_serves_the_others_once_each_was_tried() -> None:
    load = polled(40, period=40 * EXCHANGE / 0.7)
    kill(load, 30)
    load.run(31 * PROBE + 1.0)
    assert load.rate(10.0, range(31, 41)) >= 0.95 * 10 / (40 * EXCHANGE / 0.7)


def flapping(dead: float, alive: float) -> tuple[Load, int]:
    """Five minutes with one node that is dead and alive in turn; and how many changes of health were reported."""
    load = polled(8)
    load.run(10.0)

    def flap() -> None:
        faults = load.devices[1].faults
        faults.dead = 1.0 - faults.dead

    load.every(lambda: dead if load.devices[1].faults.dead else alive, flap)
    before = len(load.changes)
    load.run(300.0)
    return load, len(load.changes) - before


@pytest.mark.slow
def test_r11_a_node_that_is_away_for_moments_is_suspect_until_it_is_calm() -> None:
    _, changes = flapping(dead=0.8, alive=2.0)
    assert changes == 1


@pytest.mark.slow
def test_r11_a_node_that_comes_and_goes_is_down_for_longer_and_longer_and_costs_the_others_little() -> None:
    load, changes = flapping(dead=4.0, alive=2.0)
    assert changes <= 3 * (5 + 300 / 30)
    alone = polled(8, alive=7)
    alone.run(10.0)
    assert load.rate(60.0, range(2, 9)) >= 0.95 * alone.rate(60.0, range(2, 9))
