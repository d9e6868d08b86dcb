"""Checks of a command: it must be an immutable value that sends the same bytes every time."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from busmaster.contract.exchange import Command, Exchange
from busmaster.contract.places import Changing, Placed
from busmaster.contract.profile import Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand

OTHER_TIMINGS = Timings(
    read=ReplyTiming(0.011, 0.022, 0.033, 0.004),
    write=ReplyTiming(0.055, 0.066, 0.077, 0.008),
    packet=ReplyTiming(0.099, 0.1, 0.11, 0.012),
)


def check_command(command: Command[Any], address: int, timings: Timings) -> Iterator[str]:
    """Yield the faults of a command, one sentence each."""
    if not str(command) or str(command) == object.__repr__(command):
        yield f"{command!r} has no text: write __str__, as in 'read element 100'"
    twin = copy.deepcopy(command)
    if twin != command:
        yield f"{command!r} does not equal its copy"
    else:
        yield from _check_hash(command, twin)
    yield from _check_immutable(twin)
    flags: tuple[Any, Any] = (command.writes, command.idempotent)
    if {type(flag) for flag in flags} != {bool}:
        yield f"{command!r}: writes and idempotent are True or False"
    elif not command.writes and not command.idempotent:
        yield f"{command!r} is a read and not idempotent: then it could not be retried"
    first, second = command.open(address, timings), command.open(address, timings)
    if first is second:
        yield f"{command!r} opens the same exchange twice: each attempt needs a fresh one"
    if not first.request or first.request != second.request:
        yield f"{command!r} sends {first.request.hex(' ')!r}, and then {second.request.hex(' ')!r}"
    own = replace(command.open(address, OTHER_TIMINGS).timing, driver_release_time=0.0)
    if own not in (OTHER_TIMINGS.read, OTHER_TIMINGS.write):
        yield f"{command!r} does not use the read or write timing of its node"
    yield from _check_announcements(command, first)


def _check_hash(command: Command[Any], twin: Command[Any]) -> Iterator[str]:
    try:
        same = hash(command) == hash(twin)
    except TypeError:
        yield f"{command!r} is not hashable"
    else:
        if not same:
            yield f"{command!r} has another hash than its copy"


def _check_immutable(command: Command[Any]) -> Iterator[str]:
    slots = (name for kind in type(command).__mro__ for name in getattr(kind, "__slots__", ()))
    for name in (*slots, *vars(type(command)).get("__annotations__", ()), "something_new"):
        try:
            setattr(command, name, None)
        except (AttributeError, TypeError):
            continue
        yield f"{type(command).__name__}.{name} can be changed: make it a frozen dataclass with slots"


def _check_announcements(command: Command[Any], exchange: Exchange[Any]) -> Iterator[str]:
    for sizes in (exchange.sizes, *(step.sizes for step in exchange.later)):
        if not 0 <= sizes.typical <= sizes.longest:
            yield f"{command!r} announces a reply of typically {sizes.typical} and at most {sizes.longest} bytes"
    if not exchange.answered and not command.writes:
        yield f"{command!r} is a read without a reply"
    yield from _check_keys(command, exchange)


def _check_keys(command: Command[Any], exchange: Exchange[Any]) -> Iterator[str]:
    """Yield the faults of the keys by which replies are compared and stored.

    They must be a tuple, without empty keys, because an empty key matches every byte.
    """
    for name in ("answers", "overdue"):
        keys: object = getattr(exchange, name, None)
        if not isinstance(keys, tuple) or not all(isinstance(key, bytes) and key for key in keys):
            yield f"{command!r}: {name} must be a tuple of the beginnings of its replies, not {keys!r}"
        elif bool(keys) is not exchange.answered:
            why = "has a reply, but no keys" if exchange.answered else "has no reply, but keys"
            yield f"{command!r} {why}: {name} is {keys!r}"


def check_invalid(builders: Iterable[Callable[[], object]]) -> Iterator[str]:
    """Yield a finding for each of `builders` that does not raise InvalidCommand."""
    for number, build in enumerate(builders):
        try:
            built = build()
        except InvalidCommand:
            continue
        except Exception as error:
            yield f"invalid[{number}] raises {error!r} in place of InvalidCommand"
        else:
            yield f"invalid[{number}] builds {built!r} in place of raising InvalidCommand"


def check_checks(profile: Profile) -> Iterator[str]:
    """Yield a finding for each sync read that writes, or whose reply could be confused with that of another."""
    seen: dict[bytes, Command[Any]] = {}
    for check in profile.sync_reads:
        if check.writes:
            yield f"the sync read {check!r} writes"
            continue
        for key in check.open(profile.addresses[0], profile.timings).answers:
            if key in seen:
                yield f"the sync reads {seen[key]!r} and {check!r} have replies with the same beginning: {key.hex(' ')}"
            seen[key] = check


def check_addresses(profile: Profile) -> Iterator[str]:
    """Yield a finding for each two addresses with the same request, and if the probe writes."""
    probe = profile.probe
    if probe.writes:
        yield f"the probe {probe!r} writes"
    if profile.addressed:
        asked: dict[bytes, int] = {}
        for address in profile.addresses:
            request = probe.open(address, profile.timings).request
            if request in asked:
                yield f"addresses {asked[request]} and {address} have the same request {request.hex(' ')}"
            asked[request] = address
    yield from check_invalid(
        partial(profile.check_address, address)
        for address in (profile.addresses[0] - 1, profile.addresses[-1] + 1)
        if address != profile.broadcast
    )


def check_places(write: Command[Any], read: Command[Any], value: Any, profile: Profile) -> Iterator[str]:
    """Yield a finding if a write declares other places or another value than the matching read returns.

    Limits would then not apply to the write. Commands without places are not checked: a node with limits rejects them.
    """
    if not isinstance(write, Changing) or not isinstance(read, Placed):
        return
    changes = write.changes(profile)
    missing = [place for place in read.places if place not in changes]
    if missing:
        yield f"{write} does not declare a change of {missing}, which {read} reads"
    elif all(changes[place] is not None for place in read.places) and read.shown(changes) != value:
        yield f"{write} declares {read.shown(changes)!r} as the new value, but {read} returns {value!r}"
