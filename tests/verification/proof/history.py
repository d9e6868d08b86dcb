"""A violation as it can be read, and as a test: the same events once more, with times.

The search remembers what happened, not when, and what is left out of its keys may allow more than is possible. So the
events of a history happen again with all their times kept, in every piece of their zones, until the violation comes
again: then there are times for it, and the earliest are told.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

from tests.verification.proof.adversary import act, actions, window
from tests.verification.proof.explore import Step, constrained, prepare, split, world_of
from tests.verification.proof.forgotten import past_replies, past_waiting, simplify
from tests.verification.proof.instants import begin_run, instant, noted, seconds
from tests.verification.proof.key import Parts
from tests.verification.proof.setups import Setup
from tests.verification.proof.shipped import set_aside
from tests.verification.proof.wire import SCRIPT, Outside, Violation
from tests.verification.proof.world import World
from tests.verification.proof.zones import Zone, origin, sample

Call: TypeAlias = tuple[float, str, Any]
"""When, in seconds; what; and with what."""
UNSEEN = ("may still come until here", "lets it go")
"""What the arbiter does not notice."""
JUST = 1e-9
"""Seconds between two things that happen at once in a test: floats are not exact."""
MOST_RUNS = 20_000


def retell(setup: Setup, histories: Sequence[Sequence[Step]], problem: str) -> list[Call] | None:
    """Return what is called and said until the problem comes, with times in seconds, by the first history by which it
    does. None if it never does: then the search had allowed more than is possible."""
    with set_aside(setup):
        prepare(setup)
        for steps in histories:
            begin_run([0])
            SCRIPT.begin(())
            world = world_of(setup)(instant(0, 0))
            parts = Parts(world)
            world.calls = []
            world.note("comes up")
            world.pump()
            for end in _endings(parts, *_saved(parts, origin()), steps, problem):
                return end
    return None


def _endings(parts: Parts, key: bytes, zone: Zone, steps: Sequence[Step], problem: str) -> Iterator[list[Call]]:
    """Depth first: `stack` holds states, each with the number of steps that led to it."""
    stack = [(0, key, zone)]
    for _ in range(MOST_RUNS):
        if not stack:
            return
        done, key, zone = stack.pop()
        action, script = steps[done]
        begin_run(sample(zone))
        world = parts.restore(key)
        begun = constrained(zone, *window(world, action)) if action in actions(world) else None
        pieces = [begun] if begun is not None else []
        while pieces:
            piece = pieces.pop()
            values = sample(piece)
            begin_run(values)
            world = parts.restore(key)
            what = ""
            try:
                act(world, action, instant(len(zone), 0), instant(len(zone) + 1, 0), script)
            except Violation as violation:
                what = str(violation)
            except Outside:
                what = "outside"
            decided, others = split(piece, noted)
            pieces += others
            last = done == len(steps) - 1
            if last and what == problem:
                yield _timed(world, decided)
            elif not (last or what):
                stack.append((done + 1, *_saved(parts, decided)))


def _saved(parts: Parts, zone: Zone) -> tuple[bytes, Zone]:
    simplify(parts.world, zone, [past_waiting, past_replies])
    return parts.save(zone, exact=True)


def _timed(world: World, zone: Zone) -> list[Call]:
    assert world.calls is not None
    values = sample(zone)
    start = world.calls[0][0]
    zero = values[start.base] + start.offset
    return [(seconds(values[time.base] + time.offset - zero), what, detail) for time, what, detail in world.calls]


def told(calls: Sequence[Call]) -> str:
    """Return a history as lines of milliseconds, what happened, and bytes."""
    lines = []
    for time, what, detail in calls:
        words = detail.hex(" ") if isinstance(detail, bytes) else "" if detail is None else str(detail)
        lines.append(f"{time * 1000:12.4f} ms  {what} {words}".rstrip())
    return "\n".join(lines)


def as_test(setup: Setup, calls: Sequence[Call], problem: str) -> str:
    """Return a history as a test: it fails where the last thing that was said is said at that time."""
    calls = [call for call in calls if call[1] not in UNSEEN]
    lines = [
        "from busmaster.arbiter.arbiter import Arbiter",
        "from busmaster.arbiter.counters import Mark",
        "from busmaster.arbiter.transaction import URGENT, Transaction",
        "from tests.verification.proof.kinds import KINDS",
        "",
        "",
        "def test_found_by_the_proof() -> None:",
        f'    """{problem}; in the world "{setup.name}"."""',
        f"    kind = KINDS[{setup.kind!r}]()",
        "    profile, commands = kind.profile, kind.commands",
        f"    how = dict(echo={setup.echo}, receive_latency={setup.receive_latency}, strict={setup.strict})",
        "    arbiter = Arbiter(profile.line.byte_time, **how)",
        "    addresses = kind.first, kind.first + 1",
        f"    nodes = [arbiter.add_node(profile, address, 0.0, retries={setup.retries}) for address in addresses]",
    ]
    ways = {
        "comes up": "arbiter.line_up({time}, paced={paced})",
        "goes down": "arbiter.line_down('lost', {time})",
        "asks": "arbiter.submit(Transaction(nodes[commands[{detail}][0]], commands[{detail}][1]), {time})",
        "asks urgently": "arbiter.submit(Transaction(nodes[0], commands[{detail}][1], URGENT), {time})",
        "begins": "hold = arbiter.exclusive(nodes[0], None, {longest})",
        "asks in sequence": "arbiter.submit("
        "Transaction(nodes[commands[{detail}][0]], commands[{detail}][1], client=hold), {time})",
        "releases": "arbiter.release(hold, {time})",
        "hears": "arbiter.data_received(bytes.fromhex({words!r}), {time})",
        "hears a damaged byte": "arbiter.byte_marked(Mark.DAMAGED, {time})",
        "is due": "arbiter.handle_timeout(max({time}, arbiter.poll_timeout()), unread={detail})",
        "has not sent": "arbiter.unsent({detail}, {time})",
        "cancels": "arbiter.cancel(arbiter._wire.transaction, {time})",
        "says": "assert arbiter.poll_transmit() == bytes.fromhex({words!r})",
        "has written": "arbiter.transmitted({time})",
    }
    for number, (time, what, detail) in enumerate(_asks_first(calls)):
        words = detail.hex(" ") if isinstance(detail, bytes) else ""
        if number == len(calls) - 1 and what == "says":
            lines.append(f"    assert arbiter.poll_transmit() is None, {problem!r}")
        else:
            when = round(time + number * JUST, 12)
            given = {"time": when, "words": words, "detail": detail}
            way = ways[what].format(**given, paced=setup.paced, longest=setup.longest_hold)
            lines.append(f"    {way}")
    return "\n".join(lines)


def _asks_first(calls: Sequence[Call]) -> list[Call]:
    """What is asked in the moment in which the line is free was asked just before."""
    ordered: list[Call] = []
    for call in calls:
        place = len(ordered)
        while call[1] == "asks" and place and ordered[place - 1][0] == call[0] and ordered[place - 1][1] != "asks":
            place -= 1
        ordered.insert(place, call)
    return ordered
