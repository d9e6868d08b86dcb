"""One trial: a master and its slaves as real processes, something between them that stands still, and a verdict."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import NamedTuple

from tests.patience import PATIENCE
from tests.printed import Printed
from tests.real_wire.kinds import KINDS

ROOT = Path(__file__).parents[2]
SETTLED = 60
"""Values before the first standstill."""
BETWEEN = (20, 80)
"""Values from one standstill's end to the next."""
SHORTEST = 0.005
CLOCK = 1e-5
"""Seconds: times are printed in microseconds."""
PORTS = {
    "pty": ("master", "write", "slaves", "output"),
    "tcp": ("master", "write", "slaves", "requests", "replies", "both"),
    "memory": ("master", "write"),
}
"""What can stand still on each kind of port: the master at any moment or just before it writes, the slaves, what the
driver holds, the network."""


class Said(NamedTuple):
    """A line of one of the processes."""

    what: str
    node: int
    of: str
    value: int
    since: float
    until: float


class Process:
    """One of ours: what it prints is kept, and it takes orders."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", *arguments]
        self._popen = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._popen.stdout is not None
        self.printed = Printed(self._popen.stdout)

    def path(self) -> str:
        """The first line of one that begins with where it listens."""
        assert self.printed.wait_for(lambda: len(self.printed) > 0), "it ended without a word"
        return self.printed.texts()[0]

    def order(self, what: str) -> None:
        assert self._popen.stdin is not None
        self._popen.stdin.write(f"{what}\n")
        self._popen.stdin.flush()

    def stop(self) -> None:
        os.kill(self._popen.pid, signal.SIGSTOP)

    def stop_at_write(self) -> None:
        """Return when it stands still."""
        self.order("stop")
        limit = time.monotonic() + PATIENCE
        while self._state() != "T":
            assert time.monotonic() < limit, "the master does not write any more"
            time.sleep(0.001)

    def _state(self) -> str:
        return Path(f"/proc/{self._popen.pid}/stat").read_text().rpartition(") ")[2][0]

    def go_on(self) -> None:
        os.kill(self._popen.pid, signal.SIGCONT)

    def wait_for(self, count: int, what: str, since: int) -> None:
        """Return when so many lines of that kind have come since the line `since`."""
        place, seen = since, 0

        def enough() -> bool:
            nonlocal place, seen
            texts = self.printed.texts(place)
            place += len(texts)
            seen += sum(text.startswith(what) for text in texts)
            return seen >= count

        if not self.printed.wait_for(enough):
            recent = " | ".join(self.printed.texts(-3))
            raise AssertionError(f"only {seen} of {count} {what.strip()}s came within {PATIENCE:g} s: {recent}")

    def end(self) -> None:
        """Its input ends; then it does."""
        assert self._popen.stdin is not None
        self._popen.stdin.close()
        try:
            self._popen.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
        self.printed.join()


@dataclass
class Verdict:
    """What came of a trial. Times in seconds."""

    standstills: list[tuple[float, float]] = field(default_factory=list)
    values: int = 0
    wrong: list[str] = field(default_factory=list)
    written: int = 0
    falsely_confirmed: list[str] = field(default_factory=list)
    failed: int = 0
    back: list[float] = field(default_factory=list)
    """From the end of each standstill of up to a second until every node had given a good value."""
    back_later: list[float] = field(default_factory=list)
    """Likewise of longer ones."""

    @property
    def longest_back(self) -> float:
        return max(self.back, default=0.0)


@contextmanager
def running(*arguments: str) -> Iterator[Process]:
    process = Process(*arguments)
    try:
        yield process
    finally:
        process.go_on()
        process.end()


def trial(protocol: str, port: str, what: str, standstills: int, longest: float = 2.0, seed: int = 1) -> Verdict:
    """Let `what` (see PORTS) stand still so often, for SHORTEST to `longest` seconds, on a saturated line."""
    chance = Random(f"{protocol} {port} {what} {seed}")
    verdict = Verdict()
    with ExitStack() as stack:
        slaves, proxy, path = None, None, "memory"
        if port != "memory":
            slaves = stack.enter_context(running("tests.real_wire.slaves", protocol, port))
            path = slaves.path()
        if what in ("requests", "replies", "both"):
            proxy = stack.enter_context(running("tests.real_wire.proxy", *path.removeprefix("socket://").split(":")))
            path = proxy.path()
        master = stack.enter_context(running("tests.real_wire.master", protocol, path))
        master.wait_for(SETTLED, "value", 0)
        begin, end = _switch(what, master, slaves, proxy)
        for _ in range(standstills):
            # short ones are as frequent as ones ten times as long; the moment within an exchange is nobody's choice
            lasting = SHORTEST * math.exp(chance.uniform(0.0, math.log(longest / SHORTEST)))
            begun = time.monotonic()
            begin()
            time.sleep(lasting)  # this is what is tried
            known = len(master.printed)
            end()
            verdict.standstills.append((begun, time.monotonic()))
            for address in KINDS[protocol].addresses:
                master.wait_for(1, f"value {address} ", known)
            master.wait_for(chance.randrange(*BETWEEN), "value", known)
    judge(protocol, verdict, [*master.printed.texts(), *(slaves.printed.texts(1) if slaves is not None else ())])
    return verdict


def _switch(
    what: str, master: Process, slaves: Process | None, proxy: Process | None
) -> tuple[Callable[[], None], Callable[[], None]]:
    """What makes it stand still, and go on."""
    if what == "master":
        return master.stop, master.go_on
    if what == "write":
        return master.stop_at_write, master.go_on
    if what == "slaves":
        assert slaves is not None
        return slaves.stop, slaves.go_on
    if what == "output":
        assert slaves is not None
        holder = slaves
        return lambda: holder.order("hold"), lambda: holder.order("release")
    assert proxy is not None
    network = proxy
    return lambda: network.order(what), lambda: network.order("neither")


def judge(protocol: str, verdict: Verdict, lines: list[str]) -> None:
    """Hold what the master got against what the slaves said and took, and when: all processes have one clock."""
    times: defaultdict[tuple[str, int, str, int], list[float]] = defaultdict(list)
    heard: list[Said] = []
    for line in lines:
        words = line.split()
        said = Said(words[0], int(words[1]), words[2], int(words[3]), float(words[4]), float(words[-1]))
        if said.what in ("said", "took"):
            times[said[:4]].append(said.until)
        else:
            heard.append(said)
    good: defaultdict[int, list[float]] = defaultdict(list)
    for said in heard:
        source = {"value": "said", "written": "took"}.get(said.what)
        if source is None:
            verdict.failed += 1
            continue
        true = any(said.since - CLOCK <= when <= said.until + CLOCK for when in times[(source, *said[1:4])])
        if said.what == "value":
            verdict.values += 1
            if true:
                good[said.node].append(said.until)
            else:
                verdict.wrong.append(f"node {said.node}: {said.value} at {said.until:.6f}")
        else:
            verdict.written += 1
            if not true:
                verdict.falsely_confirmed.append(f"node {said.node}: {said.value} at {said.until:.6f}")
    _note_returns(protocol, verdict, good)


def _note_returns(protocol: str, verdict: Verdict, good: dict[int, list[float]]) -> None:
    last = max((moments[-1] for moments in good.values()), default=-math.inf)
    for begun, ended in verdict.standstills:
        back = 0.0
        for address in KINDS[protocol].addresses:
            moments = good.get(address, [])
            place = bisect_left(moments, ended)
            back = max(back, (moments[place] if place < len(moments) else last) - ended)
        (verdict.back if ended - begun <= 1.0 else verdict.back_later).append(back)
