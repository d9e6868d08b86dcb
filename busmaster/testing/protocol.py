"""The conformance kit for a protocol: for those of busmaster, and for one that you add.

    def test_modbus_keeps_the_contract():
        check_protocol(
            PROFILE,
            [
                Case(ReadRegister(7), 17, [bytes.fromhex("11 03 02 02 2b 38 f8")], 555),
                Case(WriteRegister(7, 3), 17, [bytes.fromhex("11 06 00 07 00 03 7a 9a")]),
                Case(ReadRegister(9), 17, [bytes.fromhex("11 83 02 c1 34")], raises=Refused),
            ],
            names=lambda command, address: (address, type(command)),
            invalid=[lambda: ReadRegister(70000)],
        )

A few cases describe the content of the manual: a command, the node, its reply, and the value. From them the kit
derives the properties on which the arbiter relies (`busmaster.contract.exchange`). It raises `NotConformant` with all
faults.

- Every split of a reply gives the same result as one chunk. Longer replies are split into two, into three, and into
  single bytes. An incomplete reply is MORE, and an error when the time is over.

- No single-bit flip of a reply is accepted, except those that `unseen` lists with a reason.

- No reply to another case is accepted, unless `names` is equal for both, because replies do not distinguish them. No
  `foreign` reply is accepted.

- Any bytes end in a value, FrameError or Refused, and every exchange has an end. The listener of the profile, if there
  is one, accepts any bytes too.

- Bytes after a reply are returned. Sizes, steps, starts and closing bytes are as declared.

- `answers` and `overdue` are as declared (R15). Good replies begin with them. Commands whose good replies could be
  confused share a key. The profile's `sync_reads` are reads, and share no key.

- Commands are immutable, hashable values with a text. Bad arguments raise InvalidCommand (`invalid`).

- Every attempt sends the same bytes, and two addresses never send the same.

- A value that was written to an emulated `device` is read back (`round_trips`), and is the one that the write declares.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from random import Random
from typing import Any

from busmaster.contract.driver import Driver, Ending
from busmaster.contract.exchange import Command, Done, Exchange, FrameError, Listener
from busmaster.contract.places import Changing, Placed
from busmaster.contract.profile import Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand, Refused
from busmaster.testing.cases import Case, Foreign, NotConformant, RoundTrip, Tally, Unseen
from busmaster.testing.damage import MANY_BYTES, bytewise, flips, garbage_chunks, splits

FINDINGS_EACH = 3
"""Maximum number of findings of one kind per case: further ones would only repeat them."""
UNEXPECTED = b"\x00\x7f"

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
    for name in (*slots, "something_new"):
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


def check_good_reply(exchange: Exchange[Any], turns: Sequence[Sequence[bytes]]) -> Iterator[str]:
    """Yield the faults of a fresh exchange whose good reply is the steps of these turns.

    A turn is the steps that the node sends without a byte of the host in between. The last step decides. It begins with
    one of `answers`, or is equal to it if that is one byte. Each of `answers` occurs. All of the first turn is
    `overdue`.
    """
    steps = [step for turn in turns for step in turn]
    answers = tuple(exchange.answers)
    if steps and not _begins(steps[-1], answers):
        yield f"the good reply {steps[-1].hex(' ')} does not begin with one of its `answers` {_listed(answers)}"
    for key in answers:
        if not any(_begins(step, (key,)) for step in steps):
            yield f"no step of its good reply begins with {key.hex(' ')} of its `answers`"
    for step in turns[0] if turns else ():
        if not _begins(step, exchange.overdue):
            expected = _listed(exchange.overdue)
            yield f"before the first byte, {step.hex(' ')} can arrive and is not in `overdue`: {expected}"


def check_exchangeable(asked: Exchange[Any], other: Exchange[Any]) -> str:
    """Return the fault if `asked` accepts the reply to `other`, but they have no common key; else ''."""
    may_come = {*other.answers, *other.overdue}
    if may_come & set(asked.answers):
        return ""
    keys = _listed(sorted(may_come))
    what = f"has the `answers` {_listed(asked.answers)}, none of them a key of the other command: {keys}"
    if any(one.startswith(key) or key.startswith(one) for one in may_come for key in asked.answers):
        what += " (a key that only begins like another differs from it: use the same for both)"
    return what


def _begins(step: bytes, keys: Sequence[bytes]) -> bool:
    return any(step == key if len(key) == 1 else step.startswith(key) for key in keys)


def _listed(keys: Sequence[bytes]) -> str:
    return ", ".join(key.hex(" ") for key in keys) or "(none)"


def check_protocol(
    profile: Profile,
    cases: Iterable[Case],
    *,
    names: Callable[[Command[Any], int], Hashable] = lambda command, address: (command, address),
    foreign: Iterable[Foreign] = (),
    unseen: Iterable[Unseen] = (),
    invalid: Iterable[Callable[[], object]] = (),
    round_trips: Iterable[RoundTrip] = (),
    device: Callable[[bytes], bytes] | None = None,
    garbage: int = 100,
    seed: int = 0,
) -> Tally:
    """Raise NotConformant unless the protocol fulfils the contract for all of `cases`: see the module's text.

    `names(command, address)`: the identity that a reply contains. If it is equal for two cases, the reply to one can be
    accepted for the other. `device` gets the bytes of the host, and returns the immediate reply of the device (see
    `answers_of`). `garbage`: number of random replies for each case, drawn from `seed`. Returns the number of trials.
    """
    kit = _Kit(profile, list(cases), names, list(unseen), Random(seed))
    if not kit.cases:  # without a case nothing is checked
        raise NotConformant(profile.name, ["there is no case"])
    findings = [*check_addresses(profile), *check_checks(profile), *check_invalid(invalid)]
    for case in kit.cases:
        findings += check_command(case.command, case.address, profile.timings)
        trouble = list(kit.check_reply(case))
        if not trouble:
            for check in (kit.check_splits, kit.check_truncations, kit.check_flips, kit.check_starts):
                trouble += islice(check(case), FINDINGS_EACH)
            trouble += islice(kit.check_garbage(case, garbage), FINDINGS_EACH)
        findings += trouble
    findings += kit.check_replies_to_others()
    findings += kit.check_exchangeable()
    findings += kit.check_foreign(foreign)
    findings += kit.check_exemptions()
    for trip in round_trips:
        findings += islice(kit.check_round_trip(trip, device), FINDINGS_EACH)
    if findings:
        raise NotConformant(profile.name, findings)
    return kit.tally


class _Kit:
    def __init__(
        self,
        profile: Profile,
        cases: list[Case],
        names: Callable[[Command[Any], int], Hashable],
        unseen: list[Unseen],
        random: Random,
    ) -> None:
        self.profile = profile
        self.cases = cases
        self.tally: Tally = Counter(cases=len(cases))
        self._names = names
        self._unseen = unseen
        self._needed: set[Unseen] = set()
        self._random = random

    def listen(self, command: Command[Any], address: int) -> Driver:
        return Driver(command.open(address, self.profile.timings))

    def hear(self, case: Case, *chunks: bytes) -> Driver:
        return self.listen(case.command, case.address).feed(*chunks)

    def turns(self, case: Case) -> list[list[bytes]]:
        """Return the turns: lists of steps without a byte of the host in between, which can be one chunk."""
        driver = self.listen(case.command, case.address)
        turns: list[list[bytes]] = [[]]
        for step in case.steps:
            sent_before = len(driver.sent)
            driver.feed(step)
            turns[-1].append(step)
            if len(driver.sent) > sent_before:
                turns.append([])
        return turns

    def runs(self, case: Case) -> Iterator[tuple[list[bytes], bytes]]:
        """Yield each turn of the node as one chunk, with the bytes of the turns before."""
        runs = [b"".join(turn) for turn in self.turns(case) if turn]
        for number, run in enumerate(runs):
            yield runs[:number], run

    # the reply of a case

    def check_reply(self, case: Case) -> Iterator[str]:
        """Check the unchanged reply, and silence instead of it."""
        driver = self.listen(case.command, case.address)
        exchange = driver.exchange
        if case.request is not None and exchange.request != case.request:
            yield f"{case}: sends {exchange.request.hex(' ')} in place of {case.request.hex(' ')}"
        silence = self.listen(case.command, case.address).run_out()
        if silence.delivered is exchange.answered or silence.is_bug or silence.is_whole:
            yield f"{case}: with no reply at all it ends with {silence}"
        ending = driver.feed(*case.steps).ending if exchange.answered else driver.run_out()
        if ending is None:
            yield f"{case}: the reply {_hex(case.steps)} does not end it"
        elif case.raises is not None:
            if type(ending.error) is not case.raises:
                yield f"{case}: the reply {_hex(case.steps)} gives {ending} in place of {case.raises.__name__}"
        elif not ending.delivered or ending.value != case.value or ending.rest:
            yield f"{case}: the reply {_hex(case.steps)} gives {ending} in place of {case.value!r}"
        elif exchange.answered and len(b"".join(driver.sent)) == sum(step.sent for step in exchange.later):
            yield from self._check_announced(case, exchange, ending)

    def _check_announced(self, case: Case, exchange: Exchange[Any], ending: Ending) -> Iterator[str]:
        sizes = [exchange.sizes, *(step.sizes for step in exchange.later)]
        if len(case.steps) != len(sizes):
            yield f"{case}: {len(case.steps)} steps in place of the {len(sizes)} announced"
        for step, size in zip(case.steps, sizes, strict=False):
            if len(step) > size.longest:
                yield f"{case}: a step of {len(step)} bytes is longer than the {size.longest} announced"
        if len(ending.send) != exchange.closing:
            yield f"{case}: closes with {len(ending.send)} bytes, not with the {exchange.closing} announced"
        fresh = case.command.open(case.address, self.profile.timings)
        yield from (f"{case}: {what}" for what in check_good_reply(fresh, self.turns(case)))

    # damage on the line

    def check_splits(self, case: Case) -> Iterator[str]:
        for before, run in self.runs(case):
            whole = self.hear(case, *before, run)
            for chunks in splits(run):
                self.tally["splits"] += 1
                parts = self.hear(case, *before, *chunks)
                if parts.sent != whole.sent or not _alike(parts.ending, whole.ending):
                    yield f"{case}: {run.hex(' ')} gives {whole.ending}, and {parts.ending} as {_hex(chunks)}"
            if whole.ending is not None and whole.ending.delivered:
                more = self.hear(case, *before, run + UNEXPECTED).ending
                if more is None or more.rest != UNEXPECTED:
                    yield f"{case}: bytes after the reply in the same chunk are not returned: {more}"

    def check_truncations(self, case: Case) -> Iterator[str]:
        for before, run in self.runs(case):
            for length in range(1, len(run)):
                self.tally["truncations"] += 1
                driver = self.hear(case, *before)
                sent_before = len(driver.sent)
                driver.feed(run[:length])
                early = driver.ending is not None or len(driver.sent) > sent_before
                ending = driver.run_out()
                if early or ending.delivered or ending.is_whole or ending.is_bug:
                    when = "at once" if early else "when time runs out"
                    yield f"{case}: {length} of the {len(run)} bytes {run.hex(' ')} end {when} with {ending}"

    def check_flips(self, case: Case) -> Iterator[str]:
        for before, run in self.runs(case):
            for heard in flips(run, self.profile.line.bytesize):
                self.tally["flips"] += 1
                ways = [[heard], bytewise(heard)] if len(heard) <= MANY_BYTES else [[heard]]
                for chunks in ways:
                    ending = self.hear(case, *before, *chunks).run_out()
                    if (ending.delivered and not self._is_exempt(run, heard)) or ending.is_bug:
                        yield f"{case}: {heard.hex(' ')} in place of {run.hex(' ')} gives {ending}"
                        break

    def _is_exempt(self, reply: bytes, heard: bytes) -> bool:
        exemptions = {unseen for unseen in self._unseen if (unseen.reply, unseen.heard) == (reply, heard)}
        self._needed |= exemptions
        return bool(exemptions)

    def check_exemptions(self) -> Iterator[str]:
        for unseen in self._unseen:
            if unseen not in self._needed:
                yield f"{unseen} is detected, or no case has that reply: remove it from `unseen`"

    def check_starts(self, case: Case) -> Iterator[str]:
        """Check that a byte that is not in `starts` never begins a reply."""
        if not case.steps:
            return
        starts = self.listen(case.command, case.address).exchange.starts
        if case.steps[0][0] not in starts:
            yield f"{case}: its reply begins with {case.steps[0][0]:02x}, which is not in starts"
        for byte in range(1 << self.profile.line.bytesize):
            if byte not in starts:
                ending = self.hear(case, bytes((byte,)), *case.steps).run_out()
                if ending.delivered or isinstance(ending.error, Refused) or ending.is_bug:
                    yield f"{case}: {byte:02x}, which is not in starts, and then the reply gives {ending}"

    def check_garbage(self, case: Case, count: int) -> Iterator[str]:
        for _ in range(count):
            self.tally["garbage"] += 1
            chunks = list(garbage_chunks(self._random, b"".join(case.steps)))
            ending = self.hear(case, *chunks).run_out()
            if ending.is_bug:
                yield f"{case}: {_hex(chunks)} gives {ending}"
            if self.profile.listen is not None:
                yield from self._check_listener(self.profile.listen(), chunks)

    def _check_listener(self, listener: Listener, chunks: Iterable[bytes]) -> Iterator[str]:
        """Check that one listener accepts any unexpected bytes, one chunk after another."""
        for chunk in chunks:
            try:
                listener.feed(chunk)
            except FrameError:
                continue
            except Exception as error:
                yield f"the listener raises {error!r} for {chunk.hex(' ')}"
        if not isinstance(listener.expired(), Done):
            yield "the listener has no end when time runs out"

    # the replies of others

    def check_replies_to_others(self) -> Iterator[str]:
        """Check the first turn of each case, without repetitions in it, against all other cases."""
        replies = {id(case): self._first_turn(case) for case in self.cases}
        for mine in self.cases:
            names = self._names(mine.command, mine.address)
            alike = {id(case) for case in self.cases if self._names(case.command, case.address) == names}
            good = {replies[case] for case in alike}
            for other in self.cases:
                heard = replies[id(other)]
                if id(other) not in alike and heard:
                    why = f"the reply to {other}"
                    yield from self._check_not_accepted(mine.command, mine.address, heard, good, why)

    def check_exchangeable(self) -> Iterator[str]:
        """Check each reply in place of every other, refusals aside."""
        good = [case for case in self.cases if self._first_turn(case)]
        for mine in good:
            for other in good:
                exchanged = self.hear(mine, *other.steps).ending
                if other is not mine and exchanged is not None and exchanged.delivered:
                    asked, answered = (case.command.open(case.address, self.profile.timings) for case in (mine, other))
                    if what := check_exchangeable(asked, answered):
                        yield f"{mine}: {what}, but it accepts the reply to {other}"

    def _first_turn(self, case: Case) -> bytes:
        """Return the first turn of the node.

        It is empty for a broadcast, a refusal, and a case with a repetition.
        """
        driver = self.hear(case, *case.steps)
        repeated = len(b"".join(driver.sent)) != sum(step.sent for step in driver.exchange.later)
        return b"" if repeated or case.raises is not None else b"".join(self.turns(case)[0])

    def check_foreign(self, foreign: Iterable[Foreign]) -> Iterator[str]:
        for other in foreign:
            yield from self._check_not_accepted(other.command, other.address, other.heard, set(), other.why)

    def _check_not_accepted(
        self, command: Command[Any], address: int, heard: bytes, good: set[bytes], why: str
    ) -> Iterator[str]:
        """Check that `heard` is not accepted.

        `heard` may begin with one of the `good` replies: the remaining bytes resynchronise the line.
        """
        self.tally["foreign"] += 1
        ending = self.listen(command, address).feed(heard).run_out()
        taken = heard.removesuffix(ending.rest)
        if (ending.delivered and (taken == heard or taken not in good)) or ending.is_whole or ending.is_bug:
            yield f"{command} of {address}: {why}, {heard.hex(' ')}, gives {ending}"

    # a device

    def check_round_trip(self, trip: RoundTrip, device: Callable[[bytes], bytes] | None) -> Iterator[str]:
        if device is None:
            yield "round trips need a device"
            return
        for value in trip.values:
            self.tally["round trips"] += 1
            command = trip.write(value)
            written = self._converse(command, trip.address, device)
            if not written.delivered:
                yield f"{command}: the device's reply gives {written}"
                continue
            read = self._converse(trip.read, trip.address, device)
            if not read.delivered or read.value != trip.read_back(value):
                yield f"{command}, then {trip.read} gives {read}"
            yield from check_places(command, trip.read, trip.read_back(value), self.profile)

    def _converse(self, command: Command[Any], address: int, device: Callable[[bytes], bytes]) -> Ending:
        driver = self.listen(command, address)
        driver.feed(device(driver.exchange.request))
        for sent_before in driver.sent:
            driver.feed(device(sent_before))
        ending = driver.run_out()
        if ending.send:
            device(ending.send)
        return ending


def _alike(one: Ending | None, other: Ending | None) -> bool:
    return one is other if one is None or other is None else one.same_as(other)


def _hex(parts: Iterable[bytes]) -> str:
    return " | ".join(part.hex(" ") for part in parts)
