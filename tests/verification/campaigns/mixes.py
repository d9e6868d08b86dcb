"""What goes wrong in a campaign: mixes of faults, inside R3's assumption, inside R15's alone, and beyond both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from busmaster.emulator.faults import BEYOND as BEYOND_FAULTS
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Echo

PROMPT = (0.0005, 0.005)
"""Seconds after which a device usually answers."""


AT_MOST = 32
"""Wrong values that one reply, doubled once, may bring on a line of equal reads (R15)."""


@dataclass(frozen=True)
class Standstill:
    """What stands still now and then, for `shortest` to `longest` seconds, and loses nothing.

    `requests` and `replies`: the network on either way, as a share of the frames. `process`: the process, between what
    the arbiter says and the bytes leaving, and as often at any other moment. `held`: the driver keeps its output, and
    can tell that it has not left. `within`: the share of these that begin inside of a frame. `damaged`: the share of
    requests that their device refuses for it. `apart`: no standstill begins in another on the same way, so that
    `longest` bounds each.
    """

    requests: float = 0.0
    replies: float = 0.0
    process: float = 0.0
    held: float = 0.0
    within: float = 0.0
    damaged: float = 0.0
    shortest: float = 0.005
    longest: float = 2.0
    apart: bool = False


@dataclass(frozen=True)
class Edges:
    """What happens at the last moment that R3's assumption allows, within the last byte time of it.

    Shares: of replies that begin just before their window or maximum reply delay is over (`late`), that pause just
    before their inter-byte timeout is over (`pauses`), that get a noise byte in front of their checksum (`pushed`), of
    lone ACKs that are lost (`acks_lost`). `sums`: replies whose checksum is a control character, an ACK's too, are
    frequent.
    """

    late: float = 0.15
    pauses: float = 0.0
    pushed: float = 0.0
    acks_lost: float = 0.0
    sums: bool = False


@dataclass(frozen=True)
class Mix:
    """`device` faults strike what devices hear and say, `line` faults every frame, the host's too.

    `slow` is the share of replies that take from `span[0]` to `span[1]` of the maximum reply delay of their protocol.
    `cancel` is the share of requests whose caller goes away; `reconnects` and `deaths` are mean seconds between losses
    of the port and of a device (0: never). `chunks`: bytes reach the host as they come, a few at a time. `overdue`: the
    mix is beyond R3's assumption for what its faults do not say. `in_sync`: yet one request causes one reply at most,
    and the channel keeps order, so that R15 still allows no wrong value. `equal`: all reads are of one element, so that
    every answer can be taken for a neighbour's. `writes`: the share of requests that write. `doubled`: mean seconds
    between single replies that are said twice; each may bring AT_MOST wrong values. `shared`: several programs share
    the line, one asks far more than the others, and they hold it for sequences. `second`: the share of replies that
    come a second time, with a delay of their own, up to the maximum reply delay. `twice`: the share of requests that
    their device receives a second time, as much later, and replies to as well.
    """

    name: str
    says: str
    device: Mapping[str, float] = field(default_factory=dict)
    line: Mapping[str, float] = field(default_factory=dict)
    slow: float = 0.0
    span: tuple[float, float] = (0.3, 0.97)
    echo: Echo | None = None
    cancel: float = 0.1
    reconnects: float = 0.0
    deaths: float = 0.0
    chunks: bool = False
    latency: float | None = None
    runs: bool = False
    overdue: bool = False
    in_sync: bool = False
    equal: bool = False
    writes: float = 0.25
    doubled: float = 0.0
    second: float = 0.0
    twice: float = 0.0
    stands: Standstill | None = None
    edges: Edges | None = None
    shared: bool = False

    @property
    def beyond(self) -> bool:
        overdue = self.overdue or self.in_sync or bool(self.doubled)
        return overdue or bool(BEYOND_FAULTS & {*self.device, *self.line})

    @property
    def refuses(self) -> bool:
        return "nak" in {*self.device, *self.line} or (self.stands is not None and self.stands.damaged > 0)

    @property
    def gaps(self) -> bool:
        """Devices are away for a while, and miss what passes."""
        return bool(self.deaths) or not {"flapping", "restart"}.isdisjoint(self.device)

    def faults(self, rates: Mapping[str, float], max_reply_delay: float) -> Faults:
        """`late` stays within the maximum reply delay, together with the prompt delay it is added to."""
        faults = Faults()
        for name, rate in rates.items():
            setattr(faults, name, rate)
        faults.late_by = 0.97 * max_reply_delay - PROMPT[1]
        assert not (self.slow and faults.late), "together they would be later than the maximum reply delay"
        return faults


EVERYTHING = {
    **dict.fromkeys(("lost", "late", "flip", "truncated", "doubled", "leading", "trailing", "wrong", "deaf"), 0.03),
    **dict.fromkeys(("split", "nak"), 0.03),
    **dict.fromkeys(("babble", "drop"), 0.01),
    **dict.fromkeys(("flapping", "restart"), 0.002),
    "away_for": 2.0,
}
WITHIN = (
    Mix("calm", "nothing is wrong", runs=True),
    Mix("bytewise", "replies reach the host in pieces", {"split": 0.5}, chunks=True, runs=True),
    Mix("lost", "requests and replies are lost", {"lost": 0.1, "deaf": 0.1}, runs=True),
    Mix("late", "replies begin up to the maximum reply delay", {"lost": 0.02}, slow=0.3, runs=True),
    Mix(
        "tails", "few replies are later than usual", {"lost": 0.01}, slow=0.002, span=(0.1, 0.97), writes=0.1, runs=True
    ),
    Mix("cancelled", "callers go away, replies are late", slow=0.3, cancel=0.6, runs=True),
    Mix(
        "garbled",
        "bits flip and frames are cut",
        {"flip": 0.05, "truncated": 0.05},
        {"flip": 0.02, "lost": 0.02},
    ),
    Mix(
        "glued",
        "replies come doubled, in noise",
        {"doubled": 0.1, "leading": 0.05, "trailing": 0.05},
        latency=0.0,
    ),
    Mix(
        "glued-bytewise",
        "likewise, in pieces",
        {"doubled": 0.1, "leading": 0.05, "trailing": 0.1},
        latency=0.0,
        chunks=True,
    ),
    Mix("noise", "bursts of noise, alone or into frames", {"babble": 0.05, "late": 0.05}, {"babble": 0.02}),
    Mix("wrong", "replies for another element or unit", {"wrong": 0.1, "late": 0.1}, runs=True),
    Mix("refusals", "devices refuse unheeded", {"nak": 0.1, "late": 0.1}, runs=True),
    Mix("echo", "an adapter echoes, late and damaged at times", {"flip": 0.02, "late": 0.1}, echo=Echo(0.001, 0.02)),
    Mix(
        "deaths",
        "devices die, come and go, forget",
        {"flapping": 0.01, "restart": 0.01, "late": 0.05, "away_for": 3.0},
        deaths=5.0,
    ),
    Mix("reconnects", "the port is lost and found", {"lost": 0.02}, slow=0.2, reconnects=2.0, runs=True),
    Mix("everything", "all of it", EVERYTHING, {"flip": 0.01, "lost": 0.01}, latency=0.0, reconnects=20.0, deaths=20.0),
    Mix("shared", "programs take turns, and hold the line", shared=True, runs=True),
    Mix(
        "shared, lost",
        "likewise, what is said is lost or late",
        {"lost": 0.05, "deaf": 0.05, "late": 0.1},
        shared=True,
        cancel=0.3,
        writes=0.4,
    ),
    Mix(
        "shared, everything",
        "likewise, all of it",
        EVERYTHING,
        {"flip": 0.01, "lost": 0.01},
        latency=0.0,
        reconnects=20.0,
        deaths=20.0,
        shared=True,
    ),
    Mix("edges", "replies at the last moment", edges=Edges(), latency=0.0, writes=0.4, runs=True),
    Mix("edges, held back", "likewise, behind an adapter of 16 ms", edges=Edges(), latency=0.016, writes=0.4),
    Mix(
        "edges, equal",
        "likewise, equal reads, behind an adapter of 16 ms",
        edges=Edges(0.4),
        latency=0.016,
        equal=True,
    ),
    Mix("edges, echo", "likewise, the adapter echoes", edges=Edges(), echo=Echo(0.001), writes=0.4, runs=True),
    Mix("edges, pauses", "replies pause as long as they may", edges=Edges(0.05, 0.1, sums=True), writes=0.4),
    Mix(
        "edges, pushed",
        "a noise byte before a checksum that is an ACK, with pauses",
        edges=Edges(0.05, 0.1, 0.1, sums=True),
        writes=0.4,
    ),
    Mix("edges, lost ACKs", "an ACK is lost, its packet comes last", edges=Edges(0.3, 0.0, 0.0, 0.1), writes=0.4),
    Mix(
        "edges, all",
        "all of it, behind an adapter of 16 ms that echoes",
        {"flip": 0.02},  # a part of an overdue reply that is lost is beyond R3: what is left begins later
        edges=Edges(0.1, 0.1, 0.05, 0.05, sums=True),
        echo=Echo(),
        latency=0.016,
        writes=0.4,
    ),
)
EITHER_WAY = Standstill(requests=0.01, replies=0.01)
IN_SYNC = (
    Mix("network", "the network stands still, either way", stands=EITHER_WAY, in_sync=True),
    Mix("network, equal", "likewise, equal reads", stands=EITHER_WAY, in_sync=True, equal=True, writes=0.02),
    Mix("network, deaths", "likewise, devices die", stands=EITHER_WAY, in_sync=True, deaths=5.0, equal=True),
    Mix(
        "network, refusals",
        "likewise, devices refuse",
        {"nak": 0.1},
        stands=EITHER_WAY,
        in_sync=True,
        equal=True,
        writes=0.1,
    ),
    Mix(
        "network, lost",
        "likewise, requests and replies are lost",
        {"lost": 0.02, "deaf": 0.02},
        stands=EITHER_WAY,
        in_sync=True,
        equal=True,
        writes=0.1,
    ),
    Mix(
        "network, reconnects",
        "likewise, the port is lost and found",
        stands=EITHER_WAY,
        in_sync=True,
        equal=True,
        reconnects=2.0,
        writes=0.1,
    ),
    Mix("network, shared", "likewise, programs take turns", stands=EITHER_WAY, in_sync=True, shared=True, writes=0.3),
    Mix("network, runs", "likewise, short commands", stands=EITHER_WAY, in_sync=True, runs=True),
    Mix(
        "network, within",
        "likewise, within frames",
        stands=Standstill(requests=0.01, replies=0.01, within=0.7),
        in_sync=True,
        equal=True,
        writes=0.1,
    ),
    Mix("process", "the process stands still", stands=Standstill(process=0.01), in_sync=True),
    Mix(
        "process, equal",
        "likewise, equal reads",
        stands=Standstill(process=0.01),
        in_sync=True,
        equal=True,
        writes=0.02,
    ),
    Mix("held", "the driver holds output", stands=Standstill(held=0.01, shortest=0.1, longest=0.8), in_sync=True),
    Mix(
        "held, equal",
        "likewise, equal reads",
        stands=Standstill(held=0.01, shortest=0.1, longest=0.8),
        in_sync=True,
        equal=True,
        writes=0.02,
    ),
    Mix(
        "held, within",
        "likewise, within frames",
        stands=Standstill(held=0.01, within=0.7, shortest=0.1, longest=0.8),
        in_sync=True,
        equal=True,
        writes=0.1,
    ),
    Mix(
        "all stand still",
        "network, process and driver, losses, deaths",
        {"lost": 0.01, "deaf": 0.01},
        stands=Standstill(0.01, 0.01, 0.005, 0.005),
        in_sync=True,
        equal=True,
        deaths=10.0,
        reconnects=20.0,
    ),
)
LONG = Standstill(replies=0.02, damaged=0.05, shortest=0.01, longest=6.0, apart=True)
BOTH_LONG = Standstill(requests=0.01, replies=0.01, damaged=0.05, shortest=0.01, longest=4.5, apart=True)
"""Together shorter than what is remembered of a reply (LAPSE)."""
STANDING_LONG = (
    Mix("long", "the way back stands still for up to 6 s, requests are damaged", stands=LONG, in_sync=True, writes=0.4),
    Mix("long, equal", "likewise, equal reads", stands=LONG, in_sync=True, equal=True, writes=0.1),
    Mix("long, either way", "likewise, either way for up to 4.5 s", stands=BOTH_LONG, in_sync=True, writes=0.4),
    Mix(
        "long, lost",
        "likewise, requests and replies are lost",
        {"lost": 0.02, "deaf": 0.02},
        stands=BOTH_LONG,
        in_sync=True,
        equal=True,
        writes=0.3,
    ),
    Mix(
        "long, all",
        "likewise, devices die, the port is lost and found",
        {"lost": 0.02, "deaf": 0.02},
        stands=BOTH_LONG,
        in_sync=True,
        writes=0.4,
        deaths=10.0,
        reconnects=20.0,
    ),
)
BEYOND_LAPSE = Standstill(requests=0.005, replies=0.005, damaged=0.05, shortest=8.0, longest=30.0)
BEYOND = (
    *IN_SYNC,
    *STANDING_LONG,
    Mix("beyond", "the network stands still for 8 to 30 s", stands=BEYOND_LAPSE, overdue=True, writes=0.4),
    Mix("doubled once", "one reply is said twice, on a line of equal reads", doubled=10.0, equal=True, writes=0.0),
    Mix("repeated", "a second reply, up to the maximum reply delay after the first", second=0.05, overdue=True),
    Mix("repeated, 2 %", "the same, one reply in 50", second=0.02, overdue=True),
    Mix("repeated rarely", "the same, one reply in 3,000", second=0.00033, overdue=True),
    Mix(
        "overdue",
        "replies begin after up to three times the maximum reply delay",
        slow=0.05,
        span=(1.0, 3.0),
        overdue=True,
    ),
    Mix("forged", "an unexpected ACK, NAK or EOT before a reply", {"forged": 0.05}),
    Mix("duplicate", "two devices answer to one address", {"duplicate": 0.05}),
    Mix("double flips", "the same bit flipped in two bytes of a reply", {"unseen": 0.05}),
    Mix("double flips both ways", "or of a request", line={"unseen": 0.05}),
    Mix("heard twice", "a request is received twice, up to the maximum reply delay apart", twice=0.05, overdue=True),
    Mix("heard twice, 2 %", "the same, one request in 50", twice=0.02, overdue=True),
    Mix("heard twice rarely", "the same, one request in 3,000", twice=0.00033, overdue=True),
    Mix("heard twice at once", "a request is received twice, back to back", line={"doubled": 0.05}, overdue=True),
    Mix("glued, delayed", "doubled replies that lie in an adapter", {"doubled": 0.1}, latency=0.004, overdue=True),
    Mix("cut", "requests are cut", line={"truncated": 0.05}, overdue=True),
    Mix("runs", "short commands, damaged requests", line={"flip": 0.05, "lost": 0.05}, runs=True, overdue=True),
    Mix("runs, deaths", "short commands, drives that hear nothing for a while", deaths=3.0, runs=True, overdue=True),
)
MIXES = {mix.name: mix for mix in (*WITHIN, *BEYOND)}
