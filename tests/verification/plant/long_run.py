"""The example's line with everything on, for minutes: a fault a minute, commands, scrapes and a reader beside."""

from __future__ import annotations

import json
import re
import sqlite3
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from tests.printed import Line
from tests.verification.plant import (
    faults_of_broker,
    faults_of_commands,
    faults_of_files,
    faults_of_line,
    faults_of_run,
)
from tests.verification.plant import faults_of_scrapes as scrapes
from tests.verification.plant.account import AUDIT, Counts, counts_of
from tests.verification.plant.brokers import PREFIX
from tests.verification.plant.holdings import Holding, json_lines, of_stdout
from tests.verification.plant.plant import HOLDERS, SETPOINT, Plant, Site, tail_of
from tests.verification.plant.programs import ROOT

MINUTE = 60.0
PERIODS = {"axes": 0.25, "health": 1.0}
EVERY = 1.0
"""Seconds between two commands, two scrapes and two looks into the database."""


class ExamplePlant(Plant):
    """The plant of examples/line.toml, with all that is switched off or commented out there switched on."""

    nodes = ("winder", "unwinder", "drive4", "drive5", "drive6", "drive7")
    telling = ()
    names = {"csv": "line.csv", "jsonl": "line.jsonl", "sqlite": "line.sqlite"}  # noqa: RUF012  never changed

    def text(self) -> str:
        text = (ROOT / "examples" / "line.toml").read_text()
        changes = {
            r'"socket://127\.0\.0\.1:5020\?baudrate=57600"': f'"{self.port}"',
            r"enabled = false": "enabled = true",
            r'"line\.sqlite"': f'"{self.paths["sqlite"]}"',
            r'"line-%Y-%m-%d\.csv"': f'"{self.paths["csv"]}"',
            r'groups = \["axes"\]': "",
            r'"line\.jsonl"': f'"{self.paths["jsonl"]}"',
            r'prefix = "slitter2"': f'prefix = "{PREFIX}"\nport = {self.gateway.port}',
            r'# spill = "([^"]*)".*': rf'spill = "{self.folder}/\1"',
            r"port = 9464": f"port = {self.metrics}",
            r'# groups = \["health"\]': 'groups = ["health"]',
            r"# (\[safe\]|within = 2|repeatable = |writes = )": r"\1",
        }
        for pattern, with_ in changes.items():
            text, count = re.subn(pattern, with_, text)
            assert count, f"examples/line.toml has no {pattern}"
        return text

    def _has_from(self, holder: str, since: float) -> bool:
        return self.latest_time(holder) > time.time() - (time.monotonic() - since)

    def latest_time(self, holder: str) -> float:
        """When the newest value that it holds was read, in seconds since 1970."""
        try:
            if holder == "sqlite":
                with closing(sqlite3.connect(f"file:{self.paths[holder]}?mode=ro", uri=True)) as database:
                    return float(database.execute("select max(time) from samples").fetchone()[0] or 0)
            if holder == "mqtt":
                values = [heard for heard in self.subscriber.heard[-80:] if heard.topic.startswith("values/")]
                return max((float(heard.payload["time"]) for heard in values), default=0.0)
            lines = tail_of(self.paths[holder]).splitlines()
            if holder == "csv":
                return datetime.fromisoformat(lines[-1].partition(",")[0]).timestamp()
            return max(float(fields["finished"]) for fields in json_lines(lines) if "finished" in fields)
        except (OSError, sqlite3.Error, IndexError, ValueError):
            return 0.0


def both_of_scrapes(plant: Plant) -> str:
    return f"{scrapes.half_open(plant)}; {scrapes.at_once(plant)}"


FAULTS: dict[str, Callable[[Plant], str | None]] = {
    "the broker is killed and restarted": faults_of_broker.killed,
    "one node is switched off and on": faults_of_line.node_off,
    "the CSV file is moved away": faults_of_files.moved("csv"),
    "the disk of CSV and JSON lines is full": faults_of_files.full("csv", "jsonl"),
    "another process locks the database for 10 s": faults_of_files.locked,
    "the serial server closes the connection, then refuses new ones": faults_of_line.port_gone,
    "70,000 refused commands": faults_of_commands.poured,
    "SIGHUP, the file unchanged": faults_of_run.hangup_unchanged,
    "1,000 half-open connections, 200 scrapes at once": both_of_scrapes,
    "the broker is stopped, then continues": faults_of_broker.stopped,
}


class Minute(NamedTuple):
    """`missed` and `unread` count until the next minute begins; `back` in seconds, None without a fault."""

    fault: str
    missed: dict[str, int]
    unread: int
    back: float | None
    note: str


@dataclass
class LongRun:
    minutes: list[Minute] = field(default_factory=list)
    samples: int = 0
    held: dict[str, Holding] = field(default_factory=dict)
    counted: dict[str, Counts] = field(default_factory=dict)
    commands: Counter[str] = field(default_factory=Counter)
    scrapes: Counter[str] = field(default_factory=Counter)
    reads: Counter[str] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def long_run(minutes: float, say: Callable[[str], None]) -> LongRun:
    """Run for so long. A minute before the first fault and one after the last tell what is so without any."""
    found = LongRun()
    site = Site(tcp=True, disk=20_000, on_disk=("csv", "jsonl"))
    with tempfile.TemporaryDirectory(prefix="busmaster-plant-") as folder, ExamplePlant(Path(folder), site) as plant:
        starts = [time.monotonic() + MINUTE * number for number in range(round(minutes))]
        notes: list[tuple[str, float | None, str]] = []
        quiet = {0, len(starts) - 1} if len(starts) > 2 else set()
        faults = iter(list(FAULTS.items()) * len(starts))
        with (
            beside(lambda: command(plant, found)),
            beside(lambda: scrape(plant, found)),
            beside(lambda: read(plant, found)),
        ):
            for number, start in enumerate(starts):
                wait_until(start)
                notes.append(("none", None, "") if number in quiet else make(plant, *next(faults)))
                say(f"minute {number + 1}: {notes[-1]}")
            wait_until(starts[-1] + MINUTE)
        status = plant.end_run()
        if status:
            found.problems.append(f"run ended with {status}")
        settle(plant, found, starts, notes)
    return found


def make(plant: Plant, name: str, fault: Callable[[Plant], str | None]) -> tuple[str, float, str]:
    plant.begins()
    plant.over_at = 0.0
    note = fault(plant) or ""
    over = plant.over_at or time.monotonic()
    return name, max(plant.flows(over).values()) - over, note


def wait_until(moment: float) -> None:
    time.sleep(max(0.0, moment - time.monotonic()))  # minutes are what is tried


@contextmanager
def beside(work: Callable[[], None]) -> Iterator[None]:
    """Do it again and again in a thread, until the block is left."""
    over = threading.Event()

    def go_on() -> None:
        while not over.wait(EVERY):
            work()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def command(plant: Plant, found: LongRun) -> None:
    """Every fifth is beyond a limit, every seventh has expired."""
    number = found.commands["sent"]
    found.commands["sent"] += 1
    value = 900 if number % 5 == 4 else 50 + number % 2
    wish = {"value": value, "id": f"beside {number}", "expires": time.time() + (-1 if number % 7 == 6 else 30)}
    plant.subscriber.send(SETPOINT, json.dumps(wish))


def scrape(plant: Plant, found: LongRun) -> None:
    try:
        plant.scrape()
    except (OSError, ValueError):
        found.scrapes["failed"] += 1
    else:
        found.scrapes["answered"] += 1


def read(plant: Plant, found: LongRun) -> None:
    """As somebody does who has sqlite3 at hand."""
    query = "select count(*) from history where time > unixepoch('now') - 10"
    done = subprocess.run(
        ["sqlite3", "-cmd", ".timeout 2000", str(plant.paths["sqlite"]), query],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    found.reads["answered" if done.returncode == 0 else "failed"] += 1


def settle(plant: Plant, found: LongRun, starts: list[float], notes: list[tuple[str, float | None, str]]) -> None:
    """Hold all that is there against what was polled."""
    lines = plant.run.printed()
    polled = of_stdout(lines, PERIODS)
    found.samples, found.held, found.counted = polled.samples, plant.holdings(), counts_of(plant.run)
    found.told = [line for line in plant.run.told if not line.startswith(AUDIT)]
    missed, unread = by_minute(lines, starts)
    found.minutes = [
        Minute(fault, missed[number], unread[number], back, note) for number, (fault, back, note) in enumerate(notes)
    ]
    if polled.vanished:
        found.problems.append(f"{polled.vanished} cycles were neither polled nor counted as missed")
    for holder in HOLDERS:
        lost = found.samples - len(found.held[holder].samples)
        if lost > sum(found.counted[holder]):
            found.problems.append(f"{holder}: {lost} lost, {found.counted[holder]}")
    found.problems += list(disagreements(found.held))
    found.problems += list(audit_gaps(plant, found))
    found.problems += [line for line in found.told if "Traceback" in line]


def by_minute(lines: list[Line], starts: list[float]) -> tuple[list[dict[str, int]], list[int]]:
    """Cycles missed, by group, and values not read, in each minute."""
    missed: list[dict[str, int]] = [dict.fromkeys(PERIODS, 0) for _ in starts]
    unread = [0 for _ in starts]
    before = dict.fromkeys(PERIODS, 0)
    for line in lines:
        number = max(0, sum(start <= line.when for start in starts) - 1)
        for fields in json_lines([line.text]):
            group = fields["group"]
            missed[number][group] += fields["missed"] - before[group]
            before[group] = fields["missed"]
            unread[number] += sum(bool(sample["error"]) for sample in fields["samples"].values())
    return missed, unread


def disagreements(held: dict[str, Holding]) -> Iterator[str]:
    """Database and broker have the same times: each value that both have must be the same."""
    mine, other = held["sqlite"].samples, held["mqtt"].samples
    differ = [mark for mark in mine.keys() & other.keys() if mine[mark] != other[mark]]
    if differ:
        yield f"sqlite and mqtt have other values, such as {differ[0]}: {mine[differ[0]]}, {other[differ[0]]}"
    if (found := Counter(map(str, held["jsonl"].values))) != (wanted := Counter(map(str, held["sqlite"].values))):
        yield f"jsonl and sqlite have other values, such as {next(iter((found - wanted) + (wanted - found)))}"


def audit_gaps(plant: Plant, found: LongRun) -> Iterator[str]:
    """Whatever was answered is on record, everywhere, as it was answered; and everywhere the record is the same."""
    answers = {
        str(heard.payload["id"]): bool(heard.payload["ok"])
        for heard in plant.subscriber.since(0.0, "result")
        if "id" in heard.payload
    }
    found.commands["answered"] = len(answers)
    found.commands["carried out"] = sum(answers.values())
    records = {kind: Counter(found.held[kind].writes) for kind in ("jsonl", "sqlite", "mqtt")}
    found.commands["on record"] = records["sqlite"].total()
    for kind, kept in records.items():
        known = dict(kept.keys())
        gaps = [mark for mark, ok in answers.items() if (known.get(mark) == "written") is not ok or mark not in known]
        if gaps:
            yield f"{kind}: {len(gaps)} commands are not on record as they were answered, such as {gaps[0]}"
    if records["jsonl"] != records["sqlite"]:
        yield f"jsonl has {records['jsonl'].total()} writes on record, sqlite {records['sqlite'].total()}"
    if lacking := records["sqlite"] - records["mqtt"]:
        yield f"mqtt lacks {lacking.total()} records, such as {next(iter(lacking))}"
