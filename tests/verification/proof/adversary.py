"""What may happen next in a world, when it may, and what it does."""

from __future__ import annotations

from math import inf
from typing import cast

from busmaster.arbiter.counters import OFFLINE, READY, RESYNCHRONISING
from tests.verification.proof import setups
from tests.verification.proof.instants import Instant
from tests.verification.proof.learned_windows import AnyTime
from tests.verification.proof.msc_world import MscWorld
from tests.verification.proof.shipped import Asker, Decided, Looked, Ranks
from tests.verification.proof.wire import SCRIPT, STRAY, Overdue, Time
from tests.verification.proof.world import Action, World

PACKETS = ("packet", "again")


def actions(world: World) -> list[Action]:
    """Return what may happen, whatever the time."""
    setup, arbiter = world.setup, world.arbiter
    if world.frozen:
        return [("written",), *_bytes(world), *_strays(world)]
    possible: list[Action] = []
    if arbiter._deadlines.line != inf:
        possible.append(("timer", "line"))
    if world.may_probe:
        possible.append(("timer", "health"))
    if arbiter._deadlines.hold != inf:
        possible.append(("timer", "hold"))
    possible += world.own_actions()
    possible += _bytes(world)
    possible += _strays(world)
    if world.unread:
        possible += [("read", "all"), ("read", "first")] if setup.cuts else [("read", "all")]
    if world.held is not None and (arbiter._wire.output.held or not setup.assumptions.held_until_asked):
        possible.append(("leaves",))
    on_wire = world.on_wire
    if setup.may(setups.CANCELS) and world.cancels and on_wire is not None and on_wire.wanted and on_wire.tag:
        possible.append(("cancel",))
    up = arbiter.state is not OFFLINE
    if setup.may(setups.URGENT) and world.urgent and up:
        possible.append(("urgent",))
    if setup.may(setups.LOSS):
        possible.append(("down",) if up else ("up",))
    if setup.may(setups.IDLE) and up and len(arbiter.dispatcher.backlog) < max(1, setup.depth):
        possible += [("ask", place) for place in setup.commands]
    return possible


def _strays(world: World) -> list[Action]:
    if not (world.setup.may(setups.STRAYS) and world.strays):
        return []
    several = world.setup.stray_bytes
    if not (world.words_are_read or world.reads_late):
        several = several[:1]  # nobody asks which it is
    return [("stray", bytes((byte,))) for byte in several]


def _bytes(world: World) -> list[Action]:
    """What the next byte of each reply may be. Whoever owes nothing any more is past his window: see `window`."""
    setup = world.setup
    possible: list[Action] = []
    echoes = any(reply.kind == "echo" for reply in world.overdue)
    for place, reply in enumerate(world.overdue):
        if reply.kind == "echo":
            if any(other.kind == "echo" for other in world.overdue[:place]):
                continue
            possible.append(("echo", place, "right"))
            if setup.may(setups.ECHO_FAULTS):
                possible += [("echo", place, "wrong"), ("echo", place, "lost")]
            continue
        if echoes or (setup.beyond and _keeps_order(world, place)):
            continue
        if reply.kind in PACKETS:
            if any(other.begun and other.kind in PACKETS for other in world.overdue[:place]):
                continue  # two talkers at once garble each other: left out
            possible.append(("all", place, None))
            if reply.faults:
                before = len(reply.packet) - len(reply.data)
                possible += [
                    ("all", place, (at - before, bit)) for at, bit in setup.damage if before <= at < len(reply.packet)
                ]
            if setup.beyond:
                possible.append(("never", place))
            if not setup.bytewise:
                continue
        if setup.whole:
            possible.append(("whole", place))
            if reply.begun:
                continue
            possible += [("part", place, length) for length in setup.pauses if length < len(reply.data)]
            possible += [("byte", place, "nak")] if setup.may(setups.NAKS) and world.may_refuse(reply.request) else []
            possible += [("never", place)] if setup.beyond else []
            continue
        possible.append(("byte", place, "right"))
        read = world.words_are_read
        if reply.faults and setup.may(setups.LOST) and (read or not setup.assumptions.pauses_hold_the_lost):
            possible.append(("byte", place, setups.LOST))
        if reply.faults and read:
            if setup.may(setups.FLIPS):
                possible += [("byte", place, bit) for bit in setup.bits]
            possible += [("byte", place, what) for what in (setups.MARKS,) if setup.may(what)]
        if setup.may(setups.NAKS) and not reply.begun:
            possible.append(("byte", place, "nak"))
        if setup.beyond and not reply.begun:
            possible.append(("never", place))
    return possible


def _keeps_order(world: World, place: int) -> bool:
    """Return whether this reply comes behind an earlier one. A node answers in order, and a channel keeps the order of
    all replies; but within their maximum reply delays one node may be slower than another."""
    reply, earlier = world.overdue[place], world.overdue[:place]
    within = world.setup.learned is not None
    return any(other.unit == reply.unit for other in earlier) if within else bool(earlier)


def window(world: World, action: Action) -> tuple[list[Time], list[Time], list[Time]]:
    """Return what the action cannot be earlier than, what it cannot be later than, and what it must be before."""
    setup, deadlines = world.setup, world.arbiter._deadlines
    earliest: list[Time] = []
    latest: list[Time] = []
    before: list[Time] = []
    what = action[0]
    if not world.frozen:
        slack = setup.stall if setup.may(setups.STALLS) else 0.0
        latest = [due + slack for due in (deadlines.line, deadlines.hold) if due != inf]
        if world.unread:
            latest.append(world.unread_by)
    if what == "timer":
        earliest.append(getattr(deadlines, action[1]))
    elif what in ("byte", "echo", "all", "whole", "part"):
        reply = world.overdue[action[1]]
        more = len(reply.data) - 1 if what in ("all", "whole") else 0
        more = action[2] - 1 if what == "part" else more
        if setup.receive_latency:  # all that an adapter holds is read within the latency of its first byte
            more = 0
        earliest.append(reply.lo + more * world.byte_time)
        if setup.beyond:  # all of it comes within that: else its end could come when R15 owes it no more
            more = 0
        (latest if reply.kind == "echo" else before).append(reply.hi + more * reply.gap)
    return _instants(earliest), _instants(latest), _instants(before)


def _instants(times: list[Time]) -> list[Instant]:
    return [time for time in times if type(time) is Instant]


def act(world: World, action: Action, now: Instant, later: Instant, script: tuple[int, ...]) -> None:
    """Let it happen now; `later` is any time from now on. Raises Violation, or Outside."""
    _begin(world, now, later, script)
    arbiter, what = world.arbiter, action[0]
    resynchronises_until: Time = arbiter._silent_at if arbiter.state is RESYNCHRONISING else None
    if what == "timer":
        if action[1] == "health":
            arbiter._deadlines.health = world.now
        unread = bool(world.unread) and world.setup.may(setups.STALLS)
        if arbiter.line_due(world.now):
            world.tell_unsent_if(asked=True)
        world.time_out(unread)
    elif what == "byte":
        _byte(world, action[1], action[2])
    elif what == "echo":
        _echo(world, world.overdue.pop(action[1]), action[2])
    elif what == "all":
        assert isinstance(world, MscWorld)
        world.hear_all(world.overdue[action[1]], action[2])
    elif what == "whole":
        reply = world.overdue.pop(action[1])
        world.over(reply)
        world.hear(reply.data, reply.origin)
    elif what == "part":
        _part(world, world.overdue[action[1]], action[2])
    elif what == "stray":
        world.strays = 0
        world.hear(action[1], STRAY)
    elif what == "read":
        world.read_unread(1 if action[1] == "first" else len(world.unread))
    elif what == "never":
        del world.overdue[action[1]]
    elif what == "written":
        out, world.frozen = world.frozen, b""
        world.wake()
        world._write(out)
    elif what == "leaves":
        assert world.held is not None
        (out, ticket), world.held = world.held, None
        world.note("lets it go", out)
        world.leaves(out, ticket, now)
    elif what == "cancel":
        world.cancel()
    elif what == "urgent":
        world.ask_urgently()
    elif what == "ask":
        world.ask(action[1])
    elif what == "down":
        world.go_down()
    elif what == "up":
        world.come_up()
    else:
        world.do(action)
    if not world.frozen:
        world.pump()
    resynchronises_on = arbiter.state is RESYNCHRONISING and arbiter._silent_at is resynchronises_until
    Looked.only[0] = resynchronises_on or arbiter.state is READY


def _begin(world: World, now: Instant, later: Instant, script: tuple[int, ...]) -> None:
    Decided.by_answer[0] = AnyTime.chosen[0] = False
    Asker.ask[0] = world.ask_one
    Asker.saturated[0] = world.is_saturated
    Ranks.of = world.ranks
    AnyTime.at[0] = cast("float", later)
    world.now = now
    world.said = b""
    world.ended = []
    SCRIPT.begin(script)


def _byte(world: World, place: int, what: object) -> None:
    reply = world.overdue[place]
    byte, reply.data = reply.data[:1], reply.data[1:]
    if what == "nak":
        byte, reply.data = world.refuse(reply), b""
    elif what != "right":
        reply.faults -= 1
        byte = b"" if what == setups.LOST else byte if what == setups.MARKS else bytes((byte[0] ^ 1 << int(str(what)),))
    reply.begun = True
    reply.lo = world.now + world.byte_time
    if what != setups.LOST or not world.setup.assumptions.pauses_hold_the_lost:
        reply.hi = world.now + reply.gap
    if not reply.data:
        del world.overdue[place]
        world.over(reply, refused=what == "nak", lost=what == setups.LOST)
    if what == setups.MARKS:
        world.mark()
    elif byte:
        world.hear(byte, reply.origin)


def _part(world: World, reply: Overdue, length: int) -> None:
    data, reply.data = reply.data[:length], reply.data[length:]
    reply.begun = True
    reply.lo = world.now + world.byte_time
    reply.hi = world.now + reply.gap
    world.hear(data, reply.origin)


def _echo(world: World, echo: Overdue, what: str) -> None:
    if what != "lost":
        data = echo.data if what == "right" else bytes((echo.data[0] ^ 1,)) + echo.data[1:]
        world.hear(data, echo.origin)
