"""What a fault cost, and whether all of it was counted and told: the row of the table."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from tests.verification.plant.holdings import Holding, Polled, of_stdout
from tests.verification.plant.plant import HOLDERS, PERIODS, Plant
from tests.verification.plant.programs import Program

SUMMARY = re.compile(r"busmaster: (\w+): \d+ (?:written|answered), (\d+) dropped")
CYCLES = re.compile(r"busmaster: (\w+): (\d+) cycles, (\d+) missed")
AUDIT = "busmaster: audit: "
"""What the record of a write begins with."""
USUAL = (
    AUDIT,
    *("no safe state", "safe state at the end", "safe state confirmed", " requests, ", " cycles, "),
    *(" written, ", " answered, ", "uart: "),
)
"""What stands on standard error without any fault."""
POINTS = 3
"""Of each group, where it was not printed."""


@dataclass
class Account:
    """`lost` and `counted` are values, by output; `unread` are those that could not be read, `missed` cycles.

    `back` is by output, in seconds from the end of the fault until it held values of all nodes that were said after.
    """

    name: str
    beyond: bool = False
    wrong: int = 0
    unread: int = 0
    missed: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    counted: dict[str, int] = field(default_factory=dict)
    kept: int = 0
    twice: int = 0
    told: list[str] = field(default_factory=list)
    back: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def longest_back(self) -> float | None:
        return max(self.back.values(), default=None)


def account(plant: Plant, name: str, uncounted: Collection[str] = (), beyond: bool = False) -> Account:
    """Hold what the outputs hold against what was polled and said. Every run has ended."""
    found = Account(name, beyond=beyond)
    polled = [of_stdout(run.printed() if run.out is not None else (), PERIODS) for run in plant.runs]
    total = sum(map(samples_of, plant.runs, polled))
    found.unread = sum(one.errors for one in polled)
    found.missed = sum(one.missed for one in polled)
    if vanished := sum(one.vanished for one in polled):
        found.problems.append(f"{vanished} cycles were neither polled nor counted as missed")
    counts = [counts_of(run) for run in plant.runs]
    held = plant.holdings()
    said = true_values(plant)
    for holder in HOLDERS:
        _hold_against(found, holder, held[holder], total, said)
        found.counted[holder] = sum(one[holder].dropped for one in counts if holder in one)
        found.kept += sum(one[holder].kept for one in counts[-1:] if holder in one)
        if found.lost[holder] > found.counted[holder] + found.kept and holder not in uncounted:
            found.problems.append(f"{holder}: {found.lost[holder]} lost, {found.counted[holder]} counted")
    found.problems += audit_problems(plant, held)
    found.told = told(plant)
    found.problems += [line for run in plant.runs for line in run.told if "Traceback" in line]
    return found


def _hold_against(found: Account, holder: str, held: Holding, total: int, said: set[tuple[str, float]]) -> None:
    found.lost[holder] = max(0, total - len(held.samples))
    wrong = [(key, value) for key, value in held.values if (key.partition("/")[0], value) not in said]
    found.wrong = max(found.wrong, len(wrong))
    if wrong and not found.beyond:
        found.problems.append(f"{holder}: {len(wrong)} wrong values, such as {wrong[0]}")
    found.twice += held.twice
    if held.twice and holder != "mqtt":
        found.problems.append(f"{holder}: {held.twice} values twice")


def samples_of(run: Program, polled: Polled) -> int:
    """How many samples were polled: by what was printed, and by the summary where that knows more."""
    total = polled.samples
    for group, cycles, _ in (match.groups() for match in map(CYCLES.match, run.told) if match):
        total += max(0, int(cycles) - polled.cycles.get(group, 0)) * polled.points.get(group, POINTS)
    return total


def true_values(plant: Plant) -> set[tuple[str, float]]:
    return {(words[1], float(words[3])) for words in plant.said() if words[0] == "said"}


class Counts(NamedTuple):
    """What an output says of itself in the end; `suppressed` is what it was not to pass on, as it was no news."""

    dropped: int
    kept: int
    suppressed: int


def counts_of(run: Program) -> dict[str, Counts]:
    """Return the counts by output, as the run's summary says."""
    found = {}
    for line in run.told:
        if summary := SUMMARY.match(line):
            kept, suppressed = (re.search(rf"(\d+) {words}", line) for words in ("kept on disk", "suppressed"))
            numbers = (int(one[1]) if one else 0 for one in (kept, suppressed))
            found[summary[1]] = Counts(int(summary[2]), *numbers)
    return found


def audit_problems(plant: Plant, held: dict[str, Holding]) -> Iterator[str]:
    """Each write that a drive took was wanted and is on record, and the records agree."""
    taken = Counter(words[1] for words in plant.said() if words[0] == "took" and words[3] != "0")
    for holder in ("jsonl", "sqlite"):
        carried_out = sum(outcome in ("written", "unconfirmed") for _, outcome in held[holder].writes)
        if taken.total() > carried_out:
            yield f"{holder}: {taken.total()} writes were taken, {carried_out} are on record"
    if sorted(held["jsonl"].writes) != sorted(held["sqlite"].writes):
        yield f"jsonl has {len(held['jsonl'].writes)} writes on record, sqlite {len(held['sqlite'].writes)}"


def told(plant: Plant) -> list[str]:
    """What was told on standard error since the fault began, each line once, and what MQTT's status said."""
    lines = [
        line.text.removeprefix("busmaster: ")
        for run in plant.runs
        for line in run.err.since(plant.fault_at)
        if not any(usual in line.text for usual in USUAL)
    ]
    return [line.replace(f"{plant.folder}/", "") for line in lines]


def status_told(plant: Plant) -> list[str]:
    found: list[str] = []
    for heard in plant.mqtt_told(plant.fault_at):
        text = heard.payload if isinstance(heard.payload, str) else str(heard.payload.get("line"))
        text = f"{heard.topic} {text}"
        if found[-1:] != [text]:
            found.append(text)
    return found
