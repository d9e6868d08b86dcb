"""The steps of a search on an unknown line, their order, and their longest duration. Nothing is opened here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

from busmaster import InvalidCommand, LineSettings
from busmaster.ext import NodeKind, Profile, protocols

USUAL = range(1, 9)
"""The nodes that are tried unless others are named."""
LISTENING = 3.0
"""Seconds of silence after which no other master is expected."""


@dataclass(frozen=True, slots=True)
class Step:
    """Try some nodes of one kind with these settings of the line. None: the settings cannot be changed from here.

    `rest` are the kind's other addresses: they are tried too if a node of its protocol has replied.
    """

    settings: LineSettings | None
    kind: NodeKind
    addresses: tuple[int, ...]
    rest: tuple[int, ...] = ()

    @property
    def seconds(self) -> float:
        """Return how long `addresses` take if no node replies."""
        return self.seconds_for(self.addresses)

    def seconds_for(self, some: Iterable[int]) -> float:
        """Return how long these addresses take if no node replies."""
        profile = self.kind.profile
        byte_time = (self.settings or profile.line).byte_time
        requests = (profile.probe.open(address, profile.timings).request for address in some)
        return sum(profile.timings.read.window + len(request) * byte_time for request in requests)


def usual_kinds() -> list[NodeKind]:
    """Return the kinds of nodes that are tried unless some are named: of each protocol those whose probes differ."""
    found: list[NodeKind] = []
    for protocol in protocols():
        for kind in protocol.kinds:
            if not any(other.protocol is protocol and other.profile.probe == kind.profile.probe for other in found):
                found.append(kind)
    return found


def steps(kinds: Iterable[NodeKind], nodes: Sequence[int] | None, allowed: LineSettings | int | None) -> list[Step]:
    """Return the steps, the likeliest settings of each kind of node first.

    `nodes`: those to try of each kind that has such addresses. `allowed`: only these settings, or only this baud rate,
    whether a protocol's document has it or not. Raises InvalidCommand if no step is left.
    """
    asked = [(kind, addresses(kind.profile, nodes), rest(kind.profile, nodes)) for kind in kinds]
    rounds = zip_longest(*(_settings(kind.profile, allowed) for kind, _, _ in asked))
    found = [
        Step(settings, kind, some, others)
        for settings_of_round in rounds
        for settings, (kind, some, others) in zip(settings_of_round, asked, strict=True)
        if settings is not None and some
    ]
    if not found:
        raise InvalidCommand("no protocol has these nodes: nothing is left to try")
    return found


def untuned_steps(kinds: Iterable[NodeKind], nodes: Sequence[int] | None) -> list[Step]:
    """Return the steps for a port whose rate and framing are set elsewhere. Raises InvalidCommand if there are none."""
    found = [Step(None, kind, addresses(kind.profile, nodes), rest(kind.profile, nodes)) for kind in kinds]
    found = [step for step in found if step.addresses]
    if not found:
        raise InvalidCommand("no protocol has these nodes: nothing is left to try")
    return found


def seconds(tried: Iterable[Step]) -> float:
    """Return the duration of all steps if no node replies, including the listening before."""
    return LISTENING + sum(step.seconds for step in tried)


def addresses(profile: Profile, nodes: Sequence[int] | None) -> tuple[int, ...]:
    """Return the addresses to try with a protocol: those that are named and exist in it, else the usual ones.

    If the usual ones do not exist in it, they are as many from its first on. If it has no addresses, it is its only
    node in any case.
    """
    if not profile.addressed:
        return (profile.addresses[0],)
    if nodes is not None:
        return tuple(node for node in nodes if node in profile.addresses)
    usual = tuple(node for node in USUAL if node in profile.addresses)
    return usual or tuple(profile.addresses[: len(USUAL)])


def rest(profile: Profile, nodes: Sequence[int] | None) -> tuple[int, ...]:
    """Return the addresses to try after a node has replied: the others, unless the user named some."""
    if nodes is not None:
        return ()
    asked = addresses(profile, nodes)
    return tuple(address for address in profile.addresses if address not in asked)


def ranges(some: Iterable[int]) -> str:
    """Return addresses as text: "0, 9-255"."""
    parts: list[tuple[int, int]] = []
    for address in sorted(some):
        if parts and address == parts[-1][1] + 1:
            parts[-1] = (parts[-1][0], address)
        else:
            parts.append((address, address))
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)


def _settings(profile: Profile, allowed: LineSettings | int | None) -> Iterator[LineSettings]:
    if isinstance(allowed, LineSettings):
        return iter((allowed,))
    known = (profile.line, *profile.other_lines)
    if allowed is None:
        return iter(known)
    return iter(dict.fromkeys(replace(settings, baudrate=allowed) for settings in known))
