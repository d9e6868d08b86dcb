"""Searches for nodes on an unknown line: listens first, sends nothing if another master is active, and only reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from busmaster import Endpoint, LineDown, LineSettings
from busmaster.app.diagnostics.diagnosis import garbage, known_frames, speed
from busmaster.app.diagnostics.examination import OPENING, Course, unseen
from busmaster.app.diagnostics.probing import Outcome, Probe, Prober, Wire
from busmaster.app.diagnostics.steps import LISTENING, Step, ranges
from busmaster.ext import QUIET, NodeKind, Protocol

RECOGNISING = 1.0
"""Seconds in which talk is listened to with each of the settings."""
RECOGNISED = 2
"""Number of whole frames by which a protocol is recognised."""
CONFIRMED = 2
"""Number of further replies that confirm a node: at wrong settings, noise may look like a reply."""
SLOW = 10.0
"""Seconds that the other addresses may take before the user is offered to stop."""
MEASURED = 10
"""Number of requests to a node that measure its reply time."""

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Found:
    """A node that replies. `starts`: seconds until its replies began, in order; `text`: its reply."""

    kind: NodeKind
    address: int
    starts: tuple[float, ...]
    text: str
    refuses: bool
    """It replies, but refuses the request: it is alive, but has no such item."""

    @property
    def protocol(self) -> Protocol:
        return self.kind.protocol

    @property
    def label(self) -> str:
        return self.kind.profile.label(self.address)


@dataclass(slots=True)
class Discovery:
    """The result of a search. `settings` are those of the line, None if unknown; `echo`: it echoes."""

    settings: LineSettings | None = None
    echo: bool = False
    found: list[Found] = field(default_factory=list)
    talk: str = ""
    """Description of another master; then nothing was sent."""
    not_asked: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """The addresses that were not tried, by kinds of nodes that were tried and may be on this line."""


class Search:
    """Searches for nodes on an open port. `report` is called with findings on the way, in words.

    `stop_offered` is called before many addresses are tried on a slow line. It informs the user how to stop, and
    returns a function that returns whether the user has done so.
    """

    def __init__(
        self,
        wire: Wire,
        endpoint: Endpoint,
        report: Report,
        progress: Course = unseen,
        stop_offered: Callable[[], Callable[[], bool]] = lambda: lambda: False,
    ) -> None:
        self._wire = wire
        self._report = report
        self._progress = progress
        self._echo = endpoint.echo
        self._stop_offered = stop_offered
        self._silent: set[tuple[LineSettings | None, bytes]] = set()
        """Requests without a reply, with the line's settings, because some protocols have the same requests."""

    async def listen(self, tried: Sequence[Step]) -> str:
        """Return a description of another master, "" if there is none. Nothing is sent. Raises LineDown."""
        wire = self._wire
        await wire.hear_all(OPENING)
        heard = await wire.hear_all(LISTENING)
        if not heard:
            return ""
        settings = list(dict.fromkeys(step.settings for step in tried))
        with self._progress("listening", len(settings)) as bar:
            for one in settings:
                if one is None or await self._tuned(one):
                    heard = await wire.hear_all(RECOGNISING, quiet=RECOGNISING) or heard
                    for step in tried:
                        known = known_frames(heard, step.kind.protocol.kinds[0].name) if step.settings == one else []
                        if len(known) >= RECOGNISED:
                            return f"another master is active, with {step.kind.profile.title}{_at(one)}: {known[0]}"
                bar.advance()
        return f"another master is active, with an unknown protocol: {garbage(heard)}"

    async def look(self, tried: Sequence[Step]) -> Discovery:
        """Try one step after the other. If nodes are found, only kinds that may share a line with them are tried then.

        Then the other addresses of their protocols are tried too. Raises LineDown.
        """
        discovery = Discovery()
        found: dict[tuple[str, int], Found] = {}
        left, asked = list(tried), list[Step]()
        with self._progress("asking", sum(len(step.addresses) for step in tried)) as bar:
            while left:
                step = left.pop(0)
                if step.settings is not None and not await self._tuned(step.settings):
                    continue
                others = [other for other in tried if other.settings == step.settings]
                asked.append(step)
                before = len(found)
                await self._ask_all(step, step.addresses, others, found, bar.advance)
                if len(found) > before:
                    discovery.settings = step.settings
                    left = [other for other in left if self._goes_with(other, step)]
                    asked = [other for other in asked if self._goes_with(other, step)]
        if found:
            await self._finish(asked, found, discovery)
        else:
            discovery.not_asked = {step.kind.name: step.rest for step in tried if step.rest}
        discovery.found = list(found.values())
        discovery.echo = self._echo
        return discovery

    async def _finish(self, asked: Sequence[Step], found: dict[tuple[str, int], Found], discovery: Discovery) -> None:
        """Try the other addresses of the protocols of which nodes have replied, and note those that were not tried."""
        known_frames = {node.protocol.name for node in found.values()}
        due = [step for step in asked if step.kind.protocol.name in known_frames and step.rest]
        discovery.not_asked = {step.kind.name: step.rest for step in asked if step.rest and step not in due}
        total, stopped = sum(step.seconds_for(step.rest) for step in due), lambda: False
        if due:
            names = "; ".join(f"{step.kind.name} {ranges(step.rest)}" for step in due)
            self._report(f"nodes have replied, so the other addresses are tried too ({names}): up to {total:.0f} s")
        if total > SLOW:
            stopped = self._stop_offered()
        with self._progress("trying the others", sum(len(step.rest) for step in due)) as bar:
            for step in due:
                if step.settings is not None and not await self._tuned(step.settings):
                    discovery.not_asked[step.kind.name] = step.rest
                    continue
                count = await self._ask_all(step, step.rest, asked, found, bar.advance, stopped)
                if count < len(step.rest):
                    discovery.not_asked[step.kind.name] = step.rest[count:]

    @staticmethod
    def _goes_with(other: Step, found: Step) -> bool:
        return other.settings == found.settings and other.kind.profile.may_share_with(found.kind.profile)

    async def _tuned(self, settings: LineSettings) -> bool:
        """Apply the settings to the port, and return whether it accepts them. Earlier bytes are discarded."""
        try:
            await self._wire.tune(settings)
        except LineDown as error:
            if self._wire.closed.is_set():
                raise
            self._report(f"left out: {error.what}")
            return False
        await self._wire.hear_all(QUIET)
        return True

    def _prober(self, step: Step) -> Prober:
        profile = step.kind.profile
        return Prober(self._wire, profile, profile.timings, (step.settings or profile.line).byte_time, echo=self._echo)

    async def _ask_all(
        self,
        step: Step,
        some: Sequence[int],
        others: Sequence[Step],
        found: dict[tuple[str, int], Found],
        advance: Callable[[], None],
        stopped: Callable[[], bool] = lambda: False,
    ) -> int:
        """Try addresses, and add the nodes that reply to `found`. Returns the number that were tried before a stop."""
        before: int | None = None
        name, profile = step.kind.protocol.name, step.kind.profile
        for number, address in enumerate(some):
            if stopped():
                return number
            request = profile.probe.open(address, profile.timings).request
            if (name, address) not in found and (step.settings, request) not in self._silent:
                probe = await self._ask(step, address, request)
                if probe.outcome is Outcome.SILENT:
                    self._silent.add((step.settings, request))
                else:
                    # A late reply arrives after the next request, so it may be that of the node before.
                    for one in (before, address):
                        if (
                            one is not None
                            and (name, one) not in found
                            and (node := await self._known(step, one, others))
                        ):
                            found[name, one] = node
                    if not found and probe.outcome is Outcome.GARBLED:
                        self._report(f"{self._place(step, address)}: {probe.text}: {garbage(probe.raw)}")
            before = address
            advance()
        return len(some)

    async def _known(self, step: Step, address: int, others: Sequence[Step]) -> Found | None:
        """Return the node that replies at an address, as the kind of node that does not refuse the kind's probe.

        A MicroFlex drive refuses what a controller has, and replies all the same.
        """
        found = await self._confirmed(step, address)
        if found is not None and found.refuses:
            for other in others:
                if other.kind.protocol is step.kind.protocol and other.kind is not step.kind:
                    better = await self._confirmed(other, address)
                    if better is not None and not better.refuses:
                        return better
        return found

    async def _ask(self, step: Step, address: int, request: bytes) -> Probe:
        """Send one request to a node. The first request that comes back reveals an adapter with an echo."""
        profile = step.kind.profile
        probe = await self._prober(step).ask(address, patience=profile.timings.read.window)
        # an echo may look like a reply: that of a Mentor II begins with EOT
        if not self._echo and probe.raw.startswith(request):
            self._echo = True
            self._report("the adapter receives its own transmissions")
            probe = await self._prober(step).ask(address, patience=profile.timings.read.window)
        return probe

    async def _confirmed(self, step: Step, address: int) -> Found | None:
        """Send further requests to a node; None unless it replies to each."""
        prober = self._prober(step)
        await self._wire.hear_all(step.kind.profile.timings.read.max_reply_delay)  # earlier replies are over then
        probes = [await prober.ask(address, alone=True) for _ in range(CONFIRMED)]
        if any(probe.outcome is not Outcome.ANSWERED for probe in probes):
            return None
        probes += [await prober.ask(address, alone=number == MEASURED - 1) for number in range(MEASURED)]
        starts = sorted(max(0.0, probe.start) for probe in probes if probe.start is not None)
        refuses = all(probe.refused for probe in probes)
        return Found(step.kind, address, tuple(starts), probes[0].text, refuses)

    def _place(self, step: Step, address: int) -> str:
        return f"{step.kind.profile.title}, {step.kind.profile.label(address)}{_at(step.settings)}"


def _at(settings: LineSettings | None) -> str:
    return "" if settings is None else f" at {speed(settings)}"
