"""What is tried on an unknown line, in which order, and how long that takes at most. Nothing is opened here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

from busmaster.contract.profile import LineSettings, Profile
from busmaster.errors import InvalidCommand
from busmaster.registry import Protocol

USUAL = range(1, 9)
"""The nodes that are asked unless others are named."""
LISTENING = 3.0
"""Seconds of silence after which nobody else is taken to talk there."""


@dataclass(frozen=True, slots=True)
class Step:
    """Ask some nodes in one protocol, the line set so. `settings` None: as it is, which cannot be changed from here."""

    settings: LineSettings | None
    protocol: Protocol
    addresses: tuple[int, ...]

    @property
    def seconds(self) -> float:
        """Return how long it takes where nobody answers."""
        profile = self.protocol.profile
        byte_time = (self.settings or profile.line).byte_time
        requests = (profile.probe.open(address, profile.timings).request for address in self.addresses)
        return sum(profile.timings.read.window + len(request) * byte_time for request in requests)


def steps(protocols: Iterable[Protocol], nodes: Sequence[int] | None, allowed: LineSettings | int | None) -> list[Step]:
    """Return what to try, the likeliest settings of each protocol first.

    `nodes`: those to ask in each protocol that has such addresses. `allowed`: these settings alone, or this baud rate
    alone, whether a protocol's document has it or not. Raises InvalidCommand where nothing is left to try.
    """
    asked = [(protocol, addresses(protocol.profile, nodes)) for protocol in protocols]
    rounds = zip_longest(*(_settings(protocol.profile, allowed) for protocol, _ in asked))
    found = [
        Step(settings, protocol, some)
        for settings_of_round in rounds
        for settings, (protocol, some) in zip(settings_of_round, asked, strict=True)
        if settings is not None and some
    ]
    if not found:
        raise InvalidCommand("no protocol has these nodes: nothing is left to try")
    return found


def untuned_steps(protocols: Iterable[Protocol], nodes: Sequence[int] | None) -> list[Step]:
    """Return what to try on a port whose rate and framing are set elsewhere. Raises InvalidCommand for nothing."""
    found = [Step(None, protocol, addresses(protocol.profile, nodes)) for protocol in protocols]
    found = [step for step in found if step.addresses]
    if not found:
        raise InvalidCommand("no protocol has these nodes: nothing is left to try")
    return found


def seconds(tried: Iterable[Step]) -> float:
    """Return how long all of them take where nobody answers, with the listening before."""
    return LISTENING + sum(step.seconds for step in tried)


def addresses(profile: Profile, nodes: Sequence[int] | None) -> tuple[int, ...]:
    """Return which nodes are asked in a protocol: of those that are named the ones that it has, else the usual ones.

    Where the usual ones do not exist in it, they are as many from its first on. Where it has no addresses, it is the
    one node that there is, whatever is named.
    """
    if not profile.addressed:
        return (profile.addresses[0],)
    if nodes is not None:
        return tuple(node for node in nodes if node in profile.addresses)
    usual = tuple(node for node in USUAL if node in profile.addresses)
    return usual or tuple(profile.addresses[: len(USUAL)])


def _settings(profile: Profile, allowed: LineSettings | int | None) -> Iterator[LineSettings]:
    if isinstance(allowed, LineSettings):
        return iter((allowed,))
    known = (profile.line, *profile.other_lines)
    if allowed is None:
        return iter(known)
    return iter(dict.fromkeys(replace(settings, baudrate=allowed) for settings in known))
