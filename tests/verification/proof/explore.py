"""The search: every event of every state, over all times that it may have, until nothing new is found."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice

from tests.verification.proof.adversary import act, actions, window
from tests.verification.proof.forgotten import simplify
from tests.verification.proof.instants import Bound, Instant, begin_run, instant, noted, set_unit, ticks
from tests.verification.proof.key import Parts, share
from tests.verification.proof.learned_windows import AnyTime
from tests.verification.proof.msc_world import MscWorld
from tests.verification.proof.setups import Setup
from tests.verification.proof.sharing_world import SharingWorld
from tests.verification.proof.shipped import Looked, set_aside
from tests.verification.proof.wire import SCRIPT, Outside, Violation
from tests.verification.proof.world import Action, World
from tests.verification.proof.zones import (
    Zone,
    at_most,
    copied,
    extended,
    less_than,
    opposite,
    origin,
    sample,
    tighten,
    united,
    within,
)

Step = tuple[Action, tuple[int, ...]]
"""What happened, and what was chosen in it."""
MOST_HISTORIES = 64
"""Of one violation."""


@dataclass
class Found:
    """What one exploration has found."""

    setup: Setup
    keys: int = 0
    zones: int = 0
    events: int = 0
    seconds: float = 0.0
    closed: bool = False
    violations: dict[str, list[list[Step]]] = field(default_factory=dict)
    """Short histories of each: not every one need be possible."""
    left: int = 0
    """Zones whose events were not looked at yet."""


class Explorer:
    """One world's search. `progress` is told of the zones found, and those done."""

    def __init__(self, setup: Setup, progress: Callable[[Found, int], None] = lambda found, done: None) -> None:
        self.found = Found(setup)
        self._progress = progress
        self._seen: dict[bytes, tuple[bytes, list[tuple[Zone, int]]]] = {}
        """The one copy of each key, and its zones, each with its place among the states."""
        self._states: list[tuple[int, Step | None, bytes, Zone]] = []
        """Where each came from, and how; its key and its zone."""
        self._done = 0
        """Those before have been looked at."""
        self._held_by: dict[int, int] = {}
        """Those that need not be, each with a later one that holds it."""
        self._quiet: dict[int, set[int]] = {}
        """Where each comes to where a deadline passes and nothing comes, waits for R15, or leaves. A look at a line
        that resynchronises is none: the end of the resynchronisation stands, and looks are some milliseconds apart.
        Where the line is READY there is nothing more to come to, though it is looked at as long as an overdue reply may
        come."""

    def run(self, limit: float, violations: int = 8) -> Found:
        """Explore for at most so many seconds of a core, or until so many kinds of violation are found."""
        found = self.found
        with set_aside(found.setup), _without_collections():
            prepare(found.setup)
            began = time.process_time()
            self._begin(found.setup)
            while self._done < len(self._states) and len(found.violations) < violations:
                found.seconds = time.process_time() - began
                if found.seconds > limit:
                    break
                if not self._done % 500:
                    self._progress(found, self._done)
                place = self._done
                self._done += 1
                if place not in self._held_by:
                    self._expand(place)
            found.seconds = time.process_time() - began
        found.closed = self._done == len(self._states)
        found.left = sum(place not in self._held_by for place in range(self._done, len(self._states)))
        if found.closed:
            self._check_progress()
        return found

    def _begin(self, setup: Setup) -> None:
        begin_run([0])
        SCRIPT.begin(())
        world = world_of(setup)(instant(0, 0))
        self._parts = Parts(world)
        world.pump()
        zone = origin()
        simplify(world, zone)
        self._keep(-1, None, *self._parts.save(zone))

    def _keep(self, parent: int, step: Step | None, key: bytes, zone: Zone) -> int:
        """Remember a state, unless one that is known holds it. Returns the place of either."""
        key, known = self._seen.setdefault(key, (key, []))
        for other, place in known:
            if within(zone, other):
                return place
        place = len(self._states)
        at = 0
        while at < len(known):
            other, before = known[at]
            if within(other, zone):
                whole: Zone | None = zone
            else:
                whole = united(zone, other) if before >= self._done else None
            if whole is None:
                at += 1
                continue
            del known[at]
            if before >= self._done:
                self._held_by[before] = place
            if whole is not zone:
                zone, at = whole, 0
        known.append((zone, place))
        self._states.append((parent, step, key, zone))
        self.found.keys, self.found.zones = len(self._seen), len(self._states) - len(self._held_by)
        return place

    def _expand(self, place: int) -> None:
        _, _, key, zone = self._states[place]
        begin_run(sample(zone))
        world = self._parts.restore(key)
        possible = [(action, *window(world, action)) for action in actions(world)]
        goes_on = False
        for action, *bounds in possible:
            begun = constrained(zone, *bounds)
            if begun is not None:
                goes_on = True
                self._happen(place, key, begun, action)
        if not goes_on:
            self.found.violations.setdefault("progress: nothing can happen any more", self._histories(place))

    def _happen(self, place: int, key: bytes, zone: Zone, action: Action) -> None:
        """Let one event happen in all its zone: piece by piece, each as one run decides."""
        now_at = len(zone) - 2
        pieces: list[tuple[Zone, tuple[int, ...]]] = [(zone, ())]
        while pieces:
            piece, script = pieces.pop()
            begin_run(sample(piece))
            world = self._parts.restore(key)
            problem = ""
            outside = False
            try:
                act(world, action, instant(now_at, 0), instant(now_at + 1, 0), script)
            except Violation as violation:
                problem = str(violation)
            except Outside:
                outside = True
            self.found.events += 1
            decided, others = split(piece, noted)
            pieces += [(other, script) for other in others]
            asked = SCRIPT.asked
            for at in range(len(script), len(asked)):
                before = tuple(chosen for chosen, _ in asked[:at])
                pieces += [(decided, (*before, other)) for other in range(1, asked[at][1])]
            if problem:
                found = self.found.violations
                if problem not in found:
                    found[problem] = self._histories(place, (action, script))
            elif not outside:
                waits = AnyTime.chosen[0] or Looked.only[0] or world.held or world.unread or world.said
                simplify(world, decided)
                next_ = self._keep(place, (action, script), *self._parts.save(decided))
                if action == ("timer", "line") and not waits:
                    self._quiet.setdefault(place, set()).add(next_)

    def _holder(self, place: int) -> int:
        """Return the state that was looked at in place of this one."""
        while place in self._held_by:
            place = self._held_by[place]
        return place

    def _check_progress(self) -> None:
        """If nothing comes, deadlines lead to a request, or to a line that is READY: they never go round."""
        quiet = {place: set(map(self._holder, next_)) for place, next_ in self._quiet.items()}
        follows = {place: len(next_) for place, next_ in quiet.items()}
        before: dict[int, list[int]] = {}
        for place, next_ in quiet.items():
            for other in next_:
                before.setdefault(other, []).append(place)
        done = [place for place in before if place not in follows]
        while done:
            place = done.pop()
            for other in before.get(place, ()):
                follows[other] -= 1
                if not follows[other]:
                    done.append(other)
        round_ = [place for place, left in follows.items() if left]
        if round_:
            self.found.violations["progress: deadlines go round and nothing leaves"] = self._histories(min(round_))

    def _histories(self, place: int, *last: Step) -> list[list[Step]]:
        """Return how a state may have been come to. Of those of united zones some states alone can go on, so that these
        are several."""
        holds: dict[int, list[int]] = {}
        for held, by in self._held_by.items():
            holds.setdefault(by, []).append(held)

        def histories(place: int) -> Iterator[list[Step]]:
            ways = [place]
            for way in ways:
                ways += holds.get(way, ())
                parent, step, _, _ = self._states[way]
                if step is None:
                    yield []
                else:
                    yield from ([*before, step] for before in histories(parent))

        return [[*history, *last] for history in islice(histories(place), MOST_HISTORIES)]


@contextmanager
def _without_collections() -> Iterator[None]:
    """Nearly all that is made is kept: to look for what is not would take a fifth of the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def prepare(setup: Setup) -> None:
    """Take this world's units and kind."""
    World.prepare(setup)
    set_unit(World.byte_time)
    share(command for _, command in World.kind.commands)
    share(World.kind.profile.sync_reads)


def world_of(setup: Setup) -> type[World]:
    is_msc, is_shared = setup.kind.startswith("msc"), bool(setup.clients or setup.longest_hold)
    if is_msc and is_shared:
        raise ValueError(f"{setup.name}: there is no world of programs that share a line of MSC units")
    return SharingWorld if is_shared else MscWorld if is_msc else World


def constrained(zone: Zone, earliest: list[Instant], latest: list[Instant], before: list[Instant]) -> Zone | None:
    """Return the zone with two more instants: now, not before the last one (x_0) nor outside its bounds, and any time
    from now on. None if empty."""
    more = extended(extended(zone))
    now = len(zone)
    possible = tighten(more, 0, now, at_most(0))
    for bound in earliest:
        possible = possible and tighten(more, bound.base, now, at_most(-bound.offset))
    for bound in latest:
        possible = possible and tighten(more, now, bound.base, at_most(bound.offset))
    for bound in before:
        possible = possible and tighten(more, now, bound.base, less_than(bound.offset))
    possible = possible and tighten(more, now, now + 1, at_most(0))
    possible = possible and tighten(more, now + 1, now, at_most(ticks(World.setup.lapse)))
    return more if possible else None


def split(zone: Zone, asked: list[Bound]) -> tuple[Zone, list[Zone]]:
    """Return the part of the zone for which all that was asked holds, and the other parts, cut off one by one."""
    others: list[Zone] = []
    decided = zone
    for i, j, bound in asked:
        if decided[i][j] <= bound:
            continue
        other = copied(decided)
        if tighten(other, j, i, opposite(bound)):
            others.append(other)
        if decided is zone:
            decided = copied(zone)
        holds = tighten(decided, i, j, bound)
        assert holds, "a sample that is not in its zone"
    return decided, others
