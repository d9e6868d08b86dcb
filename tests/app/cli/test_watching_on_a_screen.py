"""`poll` and `run` on a terminal, in this process: when a screen is drawn, the lines that it replaces, and its end."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from busmaster import Snapshot
from busmaster.app.cli import watching
from busmaster.app.cli.arguments import View
from busmaster.app.cli.ending import SIGNALS
from busmaster.app.cli.output import Level
from busmaster.app.cli.poll import KEPT, Cycles
from busmaster.app.cli.watching import Watch, p99_of
from busmaster.app.service.authorisation import Authorisation
from busmaster.emulator.serve import TcpServer
from busmaster.errors import InvalidCommand
from tests.app.cli.conftest import Command

POLL = ("--protocol", "hcp2", "--nodes", "1-2", "--items", "1,axis0.idle", "--period", "0.05")


class Terminal:
    """Standard streams that are terminals, and the text on them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.drawn: list[str] = []
        self.missing = ""
        self.stdin = self.stdout = self.stderr = True
        self.draw: Callable[[], Any] = self.left
        streams = {
            name: SimpleNamespace(isatty=lambda name=name: getattr(self, name))
            for name in ("stdin", "stdout", "stderr")
        }
        monkeypatch.setattr(watching, "sys", SimpleNamespace(**streams))
        monkeypatch.setattr(watching, "what_is_missing", lambda: self.missing)
        monkeypatch.setattr(watching, "draw", self._draw)

    async def _draw(self, address: str) -> int:
        self.drawn.append(address)
        status: int = await self.draw()
        return status

    async def left(self) -> int:
        return 0


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    return Terminal(monkeypatch)


def ends(status: int) -> Callable[[], Any]:
    async def draw() -> int:
        return status

    return draw


@pytest.fixture
def ctrl_c_after(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """End the command by Ctrl-C once cycles of so many groups were printed, three of them at least."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    usual, printed = watching.print_cycle, list[str]()
    groups = 1

    def print_cycle(watch: Watch, snapshot: Snapshot) -> None:
        usual(watch, snapshot)
        enough = len(printed) >= 3 and len(set(printed)) >= groups
        printed.append(snapshot.group)
        if not enough and len(printed) >= 3 and len(set(printed)) >= groups:
            os.kill(os.getpid(), signal.SIGINT)

    def of_groups(count: int) -> None:
        nonlocal groups
        groups = count

    monkeypatch.setattr(watching, "print_cycle", print_cycle)
    yield of_groups
    for number, handler in before.items():  # after a signal a command ignores further ones: its process ends
        signal.signal(number, handler)


@pytest.mark.parametrize("status", [0, 130, 1])
def test_a_poll_on_a_terminal_draws_no_lines_and_ends_with_its_screen(
    busmaster: Command, controllers: TcpServer, terminal: Terminal, status: int
) -> None:
    terminal.draw = ends(status)
    ran = busmaster("poll", controllers.path, *POLL)
    assert terminal.drawn
    assert ran.out == ""
    # without a value the poll itself ends with 1
    assert ran.status == (status or ran.status)
    assert "poll: " in ran.err


@pytest.mark.usefixtures("ctrl_c_after")
@pytest.mark.parametrize(
    ("options", "stream"),
    [(("--plain",), ""), (("--json",), ""), ((), "stdin"), ((), "stdout")],
)
def test_no_screen_is_drawn_where_another_form_is_wanted_or_there_is_no_terminal(
    busmaster: Command, controllers: TcpServer, terminal: Terminal, options: tuple[str, ...], stream: str
) -> None:
    if stream:
        setattr(terminal, stream, False)
    terminal.missing = "an extra"
    ran = busmaster("poll", controllers.path, *POLL, *options)
    assert (ran.status, terminal.drawn) == (130, []), ran.err
    assert "an extra" not in ran.err
    if options == ("--json",):
        assert {key for line in ran.lines for key in json.loads(line)["samples"]} >= {"1/1", "2/axis0.idle"}
    else:
        assert {line.split()[1] for line in ran.lines} == {"1/1", "1/axis0.idle", "2/1", "2/axis0.idle"}


@pytest.mark.usefixtures("ctrl_c_after")
def test_a_poll_without_the_packages_of_the_screen_names_them_and_prints_lines(
    busmaster: Command, controllers: TcpServer, terminal: Terminal
) -> None:
    terminal.missing = "an extra"
    ran = busmaster("poll", controllers.path, *POLL)
    assert "the live view needs an extra; showing plain lines" in ran.err
    assert (ran.status, terminal.drawn) == (130, [])
    assert ran.lines


@pytest.mark.usefixtures("ctrl_c_after")
@pytest.mark.parametrize("error", [OSError("no folder"), InvalidCommand("no folder")])
def test_a_screen_that_cannot_be_served_is_replaced_by_lines(
    busmaster: Command,
    controllers: TcpServer,
    terminal: Terminal,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
) -> None:
    class Unserved:
        async def __aenter__(self) -> None:
            raise error

        async def __aexit__(self, *_: object) -> None:
            pass

    titles: list[str] = []

    def served_here(authorisation: Authorisation, title: str) -> Unserved:
        assert isinstance(authorisation, Authorisation)
        titles.append(title)
        return Unserved()

    monkeypatch.setattr(watching, "served_here", served_here)
    ran = busmaster("poll", controllers.path, *POLL)
    assert titles == ["busmaster poll"]
    assert "no live view: no folder; showing plain lines" in ran.err
    assert (ran.status, terminal.drawn) == (130, [])
    assert ran.lines


def test_a_run_goes_on_without_its_terminal_and_reports_from_then_on(
    busmaster: Command,
    file: Path,
    three_controllers: TcpServer,
    terminal: Terminal,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal.draw = ends(1)
    views: list[View] = []
    summarise = Watch.summarise

    def seen(watch: Watch) -> None:
        views.append(watch.view)
        summarise(watch)

    monkeypatch.setattr(Watch, "summarise", seen)
    ran = busmaster("run", str(file), "--seconds", "0.5")
    assert [view.plain for view in views] == [True]  # events are printed again
    assert terminal.drawn
    assert ran.status == 0
    assert "the terminal was closed; polling continues without it" in ran.err
    assert "fast: " in ran.err


def test_a_run_ends_with_its_screen(busmaster: Command, file: Path, terminal: Terminal) -> None:
    ran = busmaster("run", str(file))
    assert (ran.status, ran.out) == (0, "")
    assert "the terminal was closed" not in ran.err


@pytest.mark.slow
@pytest.mark.parametrize("options", [("--plain",), ("--json",)])
def test_a_run_prints_each_group_and_reports_where_it_is_served_only_to_a_service(
    busmaster: Command, file: Path, ctrl_c_after: Callable[[int], None], options: tuple[str, ...]
) -> None:
    file.write_text(file.read_text() + '[groups.slow]\nperiod = 0.04\npoints = ["winder/11"]\n')
    ctrl_c_after(2)
    ran = busmaster("run", str(file), *options)
    assert ran.status == 130
    for name in ("winder/force", "winder/11"):
        assert any(name in line for line in ran.lines)
    assert "is served at" not in ran.err
    silent = busmaster("serve", str(file), "--seconds", "0.2")
    assert (silent.status, silent.out) == (0, "")
    assert "Slitter is served at unix:" in silent.err


def test_a_run_prints_through_the_output_that_survives_a_full_disk(
    capsys: pytest.CaptureFixture[str],
) -> None:
    printed: list[list[str]] = []
    steady: Any = SimpleNamespace(print=lambda lines: printed.append(list(lines)))
    point: Any = Point()
    sample = SimpleNamespace(error=None, value=5)
    snapshot: Any = SimpleNamespace(samples={point: sample}, finished=0.0, wall_at=lambda at: at)
    watch: Any = SimpleNamespace(view=View(), output=steady)
    watching.print_cycle(watch, snapshot)
    assert printed == [["1970-01-01T00:00:00.000Z 1/1 5"]]
    watch.output = None
    watching.print_cycle(watch, snapshot)
    assert capsys.readouterr().out == "1970-01-01T00:00:00.000Z 1/1 5\n"


# events while there is a screen


def watch_of(monkeypatch: pytest.MonkeyPatch, **view: Any) -> tuple[Watch, list[str]]:
    """A watch of no bus, and the events of its screen."""
    bus: Any = SimpleNamespace(now=lambda: 5.0, events=lambda: None)
    journal: list[str] = []
    watch = Watch(bus, "test", View(**view), authorisation=SimpleNamespace())  # type: ignore[arg-type]  # a stand-in
    watch.service = SimpleNamespace(  # type: ignore[assignment]  # replaced here
        line=SimpleNamespace(journal=SimpleNamespace(note=journal.append))
    )
    return watch, journal


@pytest.mark.parametrize(
    ("view", "screen"),
    [
        (View(), True),
        (View(read_only=True), True),
        (View(plain=True), False),
        (View(as_json=True), False),
        (View(silent=True), False),
    ],
)
def test_only_a_view_of_values_for_people_wants_a_screen(terminal: Terminal, view: View, screen: bool) -> None:
    assert watching.wants_screen(view) is screen
    assert watching.shown_on_screen(view) is screen
    terminal.missing = "an extra"
    assert not watching.shown_on_screen(view)


def test_what_happens_is_shown_on_the_screen_and_printed_only_where_it_does_no_damage(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed: list[tuple[str, Level]] = []
    monkeypatch.setattr(watching, "note", lambda text, level: printed.append((text, level)))
    watch, journal = watch_of(monkeypatch)
    watch.announce("one", Level.WARNING)
    assert (journal, printed) == (["one"], [])
    terminal.stderr = False  # it is a file
    watch.announce("two", Level.WARNING)
    assert (journal, printed) == (["one", "two"], [("two", Level.WARNING)])
    terminal.stderr = True
    watch.view = View(plain=True)
    watch.announce("three")
    assert journal[-1] == "three"
    assert printed[-1] == ("three", Level.NOTICE)
    watch.service = None
    watch.announce("four")
    assert printed[-1] == ("four", Level.NOTICE)
    assert watch.since(7.5) == 2.5


@pytest.mark.parametrize(
    ("count", "p99"), [(1, 1), (2, 2), (99, 99), (100, 99), (101, 100), (200, 198), (201, 199), (1000, 990)]
)
def test_the_p99_is_what_99_percent_do_not_exceed(count: int, p99: float) -> None:
    periods = [float(number) for number in range(count, 0, -1)]
    assert p99_of(periods) == p99
    assert sum(period <= p99 for period in periods) >= 0.99 * count


# the cycles of a line that another program owns


class Point:
    key = "1/1"
    meaning = SimpleNamespace(precision=None)


class Group:
    """Cycles at the given times, each with a sample whose read failed or not."""

    def __init__(self, *cycles: tuple[float | None, bool]) -> None:
        self._cycles = cycles

    async def __aiter__(self) -> AsyncIterator[Any]:
        for number, (started, good) in enumerate(self._cycles, 1):
            sample = SimpleNamespace(error=None if good else SimpleNamespace(what="no reply"), value=number)
            point = Point()
            yield SimpleNamespace(
                samples={point: sample}, started=started, finished=0.0, cycle=number, missed=2, wall_at=lambda at: at
            )


def cycles_of(*cycles: tuple[float | None, bool]) -> Cycles:
    remote: Any = SimpleNamespace(now=lambda: 100.0)
    found = Cycles(remote, View())
    group: Any = Group(*cycles)
    anyio.run(found.show, group)
    return found


def test_a_poll_of_a_served_line_had_values_if_any_cycle_had_one() -> None:
    assert cycles_of((1.0, True), (2.0, False)).values
    assert cycles_of((1.0, False), (2.0, True)).values
    assert not cycles_of((1.0, False), (2.0, False)).values


def test_the_summary_of_a_served_line_has_its_last_cycles_and_those_without_a_request_do_not_count(
    capfd: pytest.CaptureFixture[str],
) -> None:
    slow = [(float(number), True) for number in range(50)]
    quick = [(1000 + 0.01 * number, True) for number in range(KEPT)]
    found = cycles_of(*slow, (None, False), *quick)
    capfd.readouterr()
    found.summarise()
    assert capfd.readouterr().err == (
        f"busmaster: poll: {len(slow) + 1 + KEPT} cycles, 2 missed, period 10.00 ms mean, 10.00 ms p99\n"
    )
    assert found.since(101.5) == 1.5


def test_the_summary_of_a_served_line_without_a_cycle_reports_that(capfd: pytest.CaptureFixture[str]) -> None:
    cycles_of().summarise()
    assert capfd.readouterr().err == "busmaster: nothing was polled\n"
    cycles_of((1.0, True)).summarise()
    assert capfd.readouterr().err == "busmaster: poll: 1 cycles, 2 missed\n"
