"""A small plant of real programs: drives, `busmaster run` with every output, a broker, and those who read beside."""

from __future__ import annotations

import http.client
import json
import os
import pty
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from tests.disks import SmallDisk, small_disk
from tests.ports import free_port
from tests.printed import Line
from tests.verification.plant.brokers import PREFIX, Broker, Heard, Subscriber
from tests.verification.plant.gateway import Gateway
from tests.verification.plant.holdings import Holding, of_csv, of_jsonl, of_mqtt, of_sqlite
from tests.verification.plant.programs import ENVIRONMENT, Program, until

NODES = ("winder", "unwinder", "dancer")
PERIODS = {"fast": 0.1, "slow": 0.5}
SETPOINT = "winder/setpoint"
NICE = -15 if os.geteuid() == 0 else 0
"""Of drives and run: what else the machine has to do is not what is tried. Only root may."""
TEXT = """
title = "Plant"
port = "{port}"
[nodes.winder]
protocol = "hcp2"
address = 1
points.setpoint = {{ item = "10", unit = "N", minimum = 0, maximum = 500 }}
[nodes.unwinder]
protocol = "hcp2"
address = 2
[nodes.dancer]
protocol = "hcp2"
address = 3
[groups.fast]
period = 0.1
points = ["winder,unwinder,dancer/1"]
[groups.slow]
period = 0.5
points = ["winder,unwinder,dancer/2"]
[outputs.csv]
path = "{csv}"
[outputs.jsonl]
path = "{jsonl}"
[outputs.sqlite]
path = "{sqlite}"
{sqlite_more}
[outputs.mqtt]
port = {broker}
prefix = "{prefix}"
allow_commands = ["winder/setpoint"]
{mqtt_more}
[outputs.metrics]
port = {metrics}
groups = ["fast"]
[safe]
within = {within}
repeatable = ["winder/setpoint"]
writes = {{ "winder/setpoint" = 0 }}
[emulator]
paced = true
"""
FILES = ("csv", "jsonl", "sqlite")
HOLDERS = (*FILES, "mqtt")
"""The outputs that hold values."""


@dataclass(frozen=True, kw_only=True)
class Site:
    """How a plant is built. The outputs `on_disk` have a disk of so many kilobytes; those `in_folder` a folder."""

    tcp: bool = False
    disk: int = 0
    on_disk: tuple[str, ...] = ()
    folder: str = ""
    in_folder: tuple[str, ...] = ()
    within: float = 30.0
    """Seconds for the safe state: the machine may be busy."""
    sqlite: str = ""
    mqtt: str = ""
    """What more is said of these outputs."""
    arguments: tuple[str, ...] = ("--json",)
    environment: dict[str, str] = field(default_factory=dict)
    starts: bool = True
    """Whether drives and run are started, or only the rest is."""
    skewed: bool = False
    """Whether the clock of `run` is ours to set."""
    screen: bool = False
    """Whether `run` has a terminal."""
    stdout: str = ""
    """The file that its standard output goes to, in place of us."""


class Plant:
    """All of it, in one folder, until it is left."""

    nodes: tuple[str, ...] = NODES
    telling: tuple[str, ...] = ("telling",)
    names: Mapping[str, str] = {kind: f"plant.{kind}" for kind in FILES}

    def __init__(self, folder: Path, site: Site) -> None:
        self.folder = folder
        self.site = site
        self.runs: list[Program] = []
        self.drive_lines: list[Line] = []
        self.removed: dict[str, list[str]] = {}
        """What was in the files that somebody took away from an output."""
        self.old: dict[str, list[Path]] = {}
        """Files that somebody moved aside."""
        self.metrics = free_port()
        self.statuses: list[int] = []
        self.fault_at = self.over_at = 0.0
        self.terminal: int | None = None
        """Our end of the terminal of `run`."""
        self._stack = ExitStack()
        self._others: list[Program] = []

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self.broker = Broker(self.folder)
            stack.callback(self.broker.kill)
            self.subscriber = Subscriber(self.broker.port)
            stack.callback(self.subscriber.close)
            self.gateway = stack.enter_context(Gateway(self.broker.port))
            if self.site.disk:
                self.disk: SmallDisk = stack.enter_context(small_disk(self.site.disk))
                (self.folder / "disk").symlink_to(self.disk.folder)
            (self.folder / self.site.folder).mkdir(exist_ok=True)
            places = dict.fromkeys(self.site.on_disk, "disk") | dict.fromkeys(self.site.in_folder, self.site.folder)
            self.paths = {kind: self.folder / places.get(kind, "") / self.names[kind] for kind in FILES}
            port = f"socket://127.0.0.1:{free_port()}?baudrate=57600" if self.site.tcp else str(self.folder / "tty")
            self.port = port
            self.file = self.folder / "line.toml"
            self.file.write_text(self.text())
            self.broker.start()
            self.subscriber.connect()
            stack.callback(self._end_programs)
            self._stack = stack.pop_all()
        if self.site.starts:
            try:
                self.start_drives()
                self.start_run()
                self.flows(time.monotonic())
            except BaseException:
                self._stack.close()
                raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.close()

    def text(self) -> str:
        """The LINE.toml as it was at the start."""
        return TEXT.format(
            port=self.port,
            broker=self.gateway.port,
            prefix=PREFIX,
            metrics=self.metrics,
            within=self.site.within,
            sqlite_more=self.site.sqlite,
            mqtt_more=self.site.mqtt.format(folder=self.folder),
            **self.paths,
        )

    # the programs

    @property
    def run(self) -> Program:
        return self.runs[-1]

    def start_drives(self) -> None:
        self.drives = Program("tests.verification.plant.drives", str(self.file), *self.telling, nice=NICE)
        until(
            lambda: any("serves" in line.text for line in self.drives.printed()) or not self.drives.runs,
            "the drives are served",
        )
        assert self.drives.runs, self.drives.told

    def kill_drives(self) -> None:
        self.drives.kill()
        self.drive_lines += self.drives.printed()

    def order(self, text: str) -> None:
        """Give the drives an order, and return when it is obeyed."""
        count = len(self.drives.printed())
        self.drives.order(text)
        until(lambda: any("obeyed" in line.text for line in self.drives.printed()[count:]), f"{text!r} is obeyed")

    def start_run(self, *arguments: str, environment: dict[str, str] | None = None) -> Program:
        module = ("tests.verification.plant.skewed", str(self.folder / "skew")) if self.site.skewed else ("busmaster",)
        with ExitStack() as stack:
            out: int | IO[str] | None = None
            if self.site.screen:
                self.terminal, out = pty.openpty()
                stack.callback(os.close, out)
                threading.Thread(target=drain, args=(self.terminal,), daemon=True).start()
            elif self.site.stdout:
                out = stack.enter_context((self.folder / self.site.stdout).open("a"))
            program = Program(
                *module, "run", str(self.file), *self.site.arguments, *arguments,
                environment=self.site.environment | (environment or {}), cwd=self.folder,
                out=out, terminal=self.site.screen, nice=NICE,
            )  # fmt: skip
        self.runs.append(program)
        return program

    def end_run(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.run.send(number)
        status = self.run.wait()
        self.statuses.append(status)
        return status

    def beside(self, *arguments: str, environment: Mapping[str, str] | None = None) -> Program:
        """Start another command of busmaster; it is ended with all the others."""
        program = Program("busmaster", *arguments, cwd=self.folder, environment=environment)
        self._others.append(program)
        return program

    def once(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Another command of busmaster, to its end."""
        return subprocess.run(
            [sys.executable, "-m", "busmaster", *arguments],
            cwd=self.folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip

    def _end_programs(self) -> None:
        for program in [*self.runs, *self._others, *([self.drives] if hasattr(self, "drives") else [])]:
            program.go_on() if program.runs else None
            program.kill()

    # what somebody does to files

    def remove(self, kind: str) -> None:
        """Remove the output's file. What was in it then is lost to nobody: it was wanted so."""
        with self.paths[kind].open(encoding="utf-8") as file:
            self.paths[kind].unlink()
            self.removed.setdefault(kind, []).append(file.read())

    # facts

    def begins(self) -> None:
        """The fault begins now."""
        self.fault_at = time.monotonic()

    def over(self) -> None:
        """The fault is over now."""
        self.over_at = time.monotonic()

    def said(self) -> list[list[str]]:
        lines = [*self.drive_lines, *(self.drives.printed() if self.drives.runs else [])]
        return [line.text.split() for line in lines]

    def flows(self, since: float, holders: tuple[str, ...] = HOLDERS) -> dict[str, float]:
        """Wait until each output holds a good value of each node that was said since then; return when that was."""
        return {one: until(partial(self._has_from, one, since), f"{one} holds new values") for one in holders}

    def _has_from(self, holder: str, since: float) -> bool:
        fresh: dict[str, int] = {}
        for line in self.drives.printed(since):
            words = line.text.split()
            if words[0] == "said":
                fresh.setdefault(words[1], int(words[3]))
        held: dict[str, int] = {}
        for key, value in self.latest(holder):
            node = key.partition("/")[0]
            if isinstance(value, int | float):
                held[node] = max(held.get(node, 0), int(value))
        return fresh.keys() == set(NODES) and all(held.get(node, 0) >= fresh[node] for node in NODES)

    def latest(self, holder: str) -> list[tuple[str, Any]]:
        """The last values that an output holds."""
        try:
            if holder == "sqlite":
                with closing(
                    sqlite3.connect(f"file:{self.paths['sqlite']}?mode=ro", uri=True, timeout=5.0)
                ) as database:
                    return database.execute(
                        "select node || '/' || item, value from samples join points on points.id = point"
                        " order by samples.rowid desc limit 60"
                    ).fetchall()
            if holder == "mqtt":
                return of_mqtt([heard for heard in self.subscriber.heard[-80:] if "/" in heard.topic]).values
            tail = tail_of(self.paths[holder])
            return (of_csv([CSV_HEAD + tail]) if holder == "csv" else of_jsonl([tail])).values
        except (OSError, sqlite3.Error):
            return []

    def wait_for_cycles(self, count: int, since: int | None = None) -> None:
        """Wait until the run has printed so many cycles more."""
        first = len(self.run.printed()) if since is None else since
        until(lambda: len(self.run.printed()) >= first + count or not self.run.runs, f"{count} more cycles are printed")

    def scrape(self, timeout: float = 10.0) -> dict[str, float]:
        """The numbers of one scrape, by name and labels."""
        connection = http.client.HTTPConnection("127.0.0.1", self.metrics, timeout=timeout)
        with closing(connection):
            connection.request("GET", "/metrics")
            text = connection.getresponse().read().decode()
        rows = (line.rpartition(" ") for line in text.splitlines() if line and line[0] != "#")
        return {name: float(value) for name, _, value in rows}

    def mqtt_told(self, since: float) -> list[Heard]:
        return [heard for heard in self.subscriber.since(since) if heard.topic in ("status", "line")]

    def command(self, mark: str, value: float = 125, **more: Any) -> dict[str, Any]:
        """Have the setpoint written by MQTT, and return the answer."""
        self.subscriber.send(SETPOINT, json.dumps({"value": value, "id": mark, **more}))
        return self.subscriber.answer(mark)

    def obeys_commands(self) -> None:
        """Wait until one is carried out: a machine that is busy enough loses replies, and lets commands grow old."""
        until(lambda: bool(self.command(f"try {time.monotonic()}")["ok"]), "a command is carried out")

    # accounts

    def holdings(self) -> dict[str, Holding]:
        """What the outputs hold, once every run has ended."""
        self.order("calm")  # once it is obeyed, we have all that the drives have told before
        if self.broker.runs:
            self.subscriber.catch_up()
        texts = {kind: [*self.removed.get(kind, ())] for kind in ("csv", "jsonl")}
        paths = {kind: [*self.old.get(kind, ()), path] for kind, path in self.paths.items()}
        for kind in ("csv", "jsonl"):
            texts[kind] += [path.read_text(errors="replace") for path in paths[kind] if path.exists()]
        return {
            "csv": of_csv(texts["csv"]),
            "jsonl": of_jsonl(texts["jsonl"]),
            "sqlite": of_sqlite(path for path in paths["sqlite"] if path.exists()),
            "mqtt": of_mqtt(self.subscriber.heard),
        }


CSV_HEAD = "time,group,cycle,node,item,value,unit,quality,error\n"
TAIL = 8192


def drain(terminal: int) -> None:
    """Read what is drawn, as a terminal does, until it is closed."""
    try:
        while os.read(terminal, 65_536):
            pass
    except OSError:
        pass


def tail_of(path: Path) -> str:
    """The last whole lines of a file."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - TAIL))
        text = file.read().decode(errors="replace")
    return text.partition("\n")[2] if size > TAIL else re.sub("^time,.*\n", "", text)
