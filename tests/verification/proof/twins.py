"""Two worlds, one restored from its key, and the same fate for both: what is left out of the key must not show.

Here times are plain: all instants have the same base. Nothing is explored; walks are random, and favour the edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from random import Random
from typing import Any, TypeAlias

from tests.verification.proof.adversary import act, actions, window
from tests.verification.proof.explore import prepare, world_of
from tests.verification.proof.forgotten import FORGOTTEN, View, past_waiting, simplify
from tests.verification.proof.instants import Instant, begin_run, instant, ticks
from tests.verification.proof.key import Parts
from tests.verification.proof.setups import Setup
from tests.verification.proof.shipped import set_aside
from tests.verification.proof.wire import SCRIPT, Outside, Violation
from tests.verification.proof.world import Action, World
from tests.verification.proof.zones import origin

Forgetting: TypeAlias = Callable[[View], None]
STEPS = 40
TWIN_EVERY = 4
TWINS = 3
LONGEST_WAIT = 0.4
"""Seconds, where nothing bounds a wait."""
WINDOWS = (0.0075, 0.1)
"""Seconds in which a learned window may end, behind a request that begins now."""


class Differs(AssertionError):
    """What was left out of a key has made a difference."""


def walk(setup: Setup, seed: int, forgotten: Sequence[Forgetting] = FORGOTTEN) -> int:
    """Let the same happen to a world and to those restored from its keys; return how often they were compared."""
    random = Random(seed)
    compared = 0
    with set_aside(setup):
        prepare(setup)
        begin_run([0])
        SCRIPT.begin(())
        world = world_of(setup)(instant(0, 0))
        parts = Parts(world)
        world.pump()
        twins: list[tuple[World, int]] = []
        for step in range(STEPS):
            if step % TWIN_EVERY == random.randrange(TWIN_EVERY):
                twins = [*twins[1 - TWINS :], (_twin(parts, list(forgotten)), world.now.offset)]
            happens = _choose(world, random)
            if happens is None:
                break
            action, now, later = happens
            script = tuple(random.choice((0, 0, 0, 1, 1, 2, 3)) for _ in range(8))
            seen = _happen(world, action, now, later, script)
            for twin, since in twins:
                _drop_too_late(twin)
                if action not in actions(twin):
                    raise Differs(f"seed {seed}: {action} cannot happen to the twin")
                other = _happen(twin, action, now - since, later - since, script)
                if other != seen:
                    raise Differs(f"seed {seed}, {action}: {seen} became {other}")
                compared += 1
            if seen[0]:
                break
    return compared


def _twin(parts: Parts, forgotten: list[Forgetting]) -> World:
    simplify(parts.world, origin(), [past_waiting])
    of_twin = Parts(type(parts.world)(instant(0, 0)))
    copy = of_twin.restore(parts.save(origin(), exact=True)[0])
    simplify(copy, origin(), forgotten)
    return of_twin.restore(of_twin.save(origin(), exact=True)[0])


def _drop_too_late(world: World) -> None:
    world.overdue = [reply for reply in world.overdue if reply.hi > world.now]


def _choose(world: World, random: Random) -> tuple[Action, int, int] | None:
    """An action that may happen, its time in ticks, and any later time."""
    _drop_too_late(world)
    possible = actions(world)
    random.shuffle(possible)
    if random.random() < 0.5:
        possible.sort(key=lambda action: action[0] == "timer")
    for action in possible:
        earliest, latest, before = window(world, action)
        low = max([world.now.offset, *(time.offset for time in earliest)])
        high = min([time.offset for time in latest] + [time.offset - 1 for time in before], default=None)
        if high is None:
            high = low + ticks(LONGEST_WAIT)
        if low <= high:
            edges = [low, min(low + 1, high), max(high - 1, low), high, random.randint(low, high)]
            now = random.choice(edges)
            later = random.choice((0, 1, random.randint(0, ticks(LONGEST_WAIT))))
            if world.setup.learned is not None:  # what is any time is a window's end
                later = random.randint(*map(ticks, WINDOWS))
            return action, now, now + later
    return None


def _happen(world: World, action: Action, now: int, later: int, script: tuple[int, ...]) -> tuple[Any, ...]:
    """What can be seen of it: what is said and told, the state, and when something is due."""
    problem = ""
    try:
        act(world, action, instant(0, now), instant(0, later), script)
    except Violation as violation:
        problem = str(violation)
    except Outside:
        problem = "outside"
    due: Any = world.arbiter.poll_timeout()
    due = due.offset - now if isinstance(due, Instant) else str(due)
    return problem, world.said, world.ended, world.arbiter.state.name, due
