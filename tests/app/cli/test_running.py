"""`busmaster run` in this process: its options, reloads, reports and ends."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from busmaster.app.cli import run
from busmaster.app.cli.arguments import View
from busmaster.app.cli.hangups import Hangups
from busmaster.app.cli.output import Level
from busmaster.app.cli.run import Running, output_text
from busmaster.app.config import LineFile, load
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.base import OutputStatistics
from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import Command
from tests.patience import PATIENCE

SAFE = """[safe]
within = 7.0
repeatable = ["winder/force", "winder/11"]
writes = { "winder/force" = 1.5, "winder/11" = 2 }
"""


# what the command makes of its options


class HandedOver:
    """How a line would be run: what `run` hands over, and how that ends."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ends: Callable[[], int] = lambda: 0
        self.running: Any = None
        self.recording: dict[str, Any] = {}
        self.interval = 0.0
        self.hangup: Any = None
        self.line: dict[str, Any] = {}
        monkeypatch.setattr(run, "ConfiguredLine", self._line)
        monkeypatch.setattr(run, "until_ended", self._until_ended)
        monkeypatch.setattr(run, "capturing", self._capturing)

    def _until_ended(self, function: Any) -> int:
        self.running, self.interval = function.__self__, sys.getswitchinterval()
        self.hangup = signal.getsignal(signal.SIGHUP)
        return self.ends()

    def _line(self, file: LineFile, **options: Any) -> ConfiguredLine:
        self.line = dict(options)
        options.pop("tap")
        return ConfiguredLine(file, **options)

    @contextmanager
    def _capturing(self, capture: str | None, **options: Any) -> Iterator[str]:
        self.recording = {"capture": capture, **options}
        yield "the recorder"


@pytest.fixture
def handed(monkeypatch: pytest.MonkeyPatch) -> HandedOver:
    return HandedOver(monkeypatch)


def test_a_run_without_options_is_that_of_the_file(busmaster: Command, file: Path, handed: HandedOver) -> None:
    usual = sys.getswitchinterval()
    assert busmaster("run", str(file)).status == 0
    line = handed.running.line
    port = line.file.port.name
    assert line.bus.endpoint.name == port
    assert not line.authorisation.read_only
    assert handed.recording == {"capture": None, "port": port, "protocol": "hcp2", "echo": False}
    assert handed.interval == pytest.approx(run.SWITCH_INTERVAL)
    assert sys.getswitchinterval() == usual
    assert handed.running._view == View()
    assert handed.running.watch.output is not None  # a full disk does not end it
    assert handed.running.watch._of_file  # so advice about a late reply names the key of the file


@pytest.mark.parametrize("command", ["run", "serve"])
def test_each_option_of_a_run_has_its_effect(
    busmaster: Command, file: Path, handed: HandedOver, command: str, tmp_path: Path
) -> None:
    file.write_text(file.read_text() + '[nodes.other]\nprotocol = "microflex"\naddress = 7\n' + SAFE)
    capture = str(tmp_path / "x.pcapng")
    options = ("--port", "socket://127.0.0.1:7", "--read-only", "--capture", capture, "--seconds", "2.5")
    usual = signal.getsignal(signal.SIGHUP)
    assert busmaster(command, str(file), *options).status == 0
    line = handed.running.line
    assert handed.hangup == handed.running._hangups._receive  # by default the signal ends a process
    assert signal.getsignal(signal.SIGHUP) == usual
    assert line.bus.endpoint.name == "127.0.0.1:7"
    assert line.authorisation.read_only
    # the recorder knows the protocol of a line only if there is one
    assert handed.recording == {"capture": capture, "port": "127.0.0.1:7", "protocol": "", "echo": False}
    assert handed.line["tap"] == "the recorder"
    assert handed.line["wait_for_port"] is True
    assert handed.running._view == View(2.5, read_only=True, silent=command == "serve")
    assert handed.running._ending.patience == 7.0 + run.CLOSE_WITHIN


def test_a_line_with_an_echo_is_recorded_as_one(busmaster: Command, file: Path, handed: HandedOver) -> None:
    file.write_text(file.read_text().replace("?baudrate=57600", "?baudrate=57600&echo=true"))
    ran = busmaster("run", str(file))
    assert ran.status == 0, ran.err
    assert handed.recording["echo"] is True


def ends_with(error: BaseException) -> Callable[[], int]:
    def end() -> int:
        raise error

    return end


@pytest.mark.parametrize(
    ("end", "status"),
    [
        (lambda: 0, 0),
        (lambda: 130, 130),
        (ends_with(SystemExit(128 + signal.SIGTERM)), 0),
        (ends_with(SystemExit(128 + signal.SIGQUIT)), 128 + signal.SIGQUIT),
        (ends_with(KeyboardInterrupt()), 130),
    ],
)
def test_the_status_is_how_the_run_was_ended_or_1_for_an_unconfirmed_safe_state(
    busmaster: Command, file: Path, handed: HandedOver, end: Callable[[], int], status: int
) -> None:
    handed.ends = end
    assert busmaster("run", str(file)).status == status

    def unsafe() -> int:
        handed.running.left_safely = False
        return end()

    handed.ends = unsafe
    assert busmaster("run", str(file)).status == 1


# a line that runs


class Reports(list[tuple[str, Level]]):
    """The lines on standard error, each with its level."""

    def note(self, text: str, level: Level = Level.INFO) -> None:
        self.append((text, level))

    def count(self, part: Any) -> int:
        return sum(part in text for text, _ in self)

    def level_of(self, part: str) -> Level:
        return next(level for text, level in self if part in text)


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> Reports:
    found = Reports()
    for module in ("run", "safe"):
        monkeypatch.setattr(f"busmaster.app.cli.{module}.note", found.note)
    return found


async def comes_true(fact: Callable[[], Any]) -> None:
    with anyio.fail_after(PATIENCE):
        while not fact():  # noqa: ASYNC110  a thread or another task makes it true
            await anyio.sleep(0.005)


def write(path: Path, text: str) -> None:
    path.write_text(text)


class Manager:
    """A service manager that keeps its messages."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def __getattr__(self, name: str) -> Callable[[], None]:
        return lambda: self.said.append(name)

    async def show_life(self, bus: Any) -> None:
        self.said.append("show_life")


Story = Callable[[Running, Callable[[], Awaitable[None]]], Awaitable[None]]


def on_a_run(file: Path, story: Story) -> Running:
    """Run a line while a story runs, which gets the run and what reads the file again."""
    hangups = Hangups()
    running = Running(ConfiguredLine(load(file), wait_for_port=True), str(file), View(silent=True), hangups, None)
    running._manager.close()
    running._manager = manager = Manager()  # type: ignore[assignment]  # replaced here

    async def reload() -> None:
        count = len(manager.said)
        hangups._receive(signal.SIGHUP, None)
        await comes_true(lambda: manager.said[count:] == ["reloading", "ready"])

    async def run_story() -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(running.run)
            await comes_true(lambda: "show_life" in manager.said)
            await story(running, reload)
            tasks.cancel_scope.cancel()

    anyio.run(run_story)
    assert manager.said[0] == "ready"
    assert manager.said[-2:] == ["stopping", "close"]
    return running


def test_a_reload_replaces_title_groups_and_points(
    file: Path, reported: Reports, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted: list[Any] = []
    gains: list[Any] = []

    async def gain(running: Running) -> None:
        gains.append(running)

    monkeypatch.setattr(Running, "_print_gain_of_learning", gain)
    text = file.read_text().replace('title = "Slitter"', 'title = "Winder"')
    slow = '[groups.slow]\nperiod = 0.05\npoints = ["winder/11"]\n'
    monkeypatch.setattr("busmaster.app.cli.run.ext.accept_device", accepted.append)

    async def story(running: Running, reload: Callable[[], Awaitable[None]]) -> None:
        service, bus = running.watch.service, running.line.bus
        assert service is not None
        assert service.report == running._print_refusals
        assert gains == [running]
        assert running.line.outputs.report == running._print_output_event
        fast = running.watch.groups[0]
        write(file, text.replace("[groups.fast]", f"{slow}[groups.fast]"))
        await reload()
        assert service.line.title == "Winder"
        assert [group.name for group in running.watch.groups] == ["slow", "fast"]
        assert running.watch.groups[1] is fast
        assert accepted == [bus]
        write(file, text.replace("[groups.fast]", "[groups.other]"))
        await reload()
        assert [group.name for group in running.watch.groups] == ["other"]
        write(file, text.partition("[groups")[0])
        await reload()
        assert running.watch.groups == []

    on_a_run(file, story)
    assert reported.count(f"{file} was reloaded") == 3
    assert reported.level_of("was reloaded") is Level.NOTICE
    assert reported.count("nothing is polled, because the file has no poll group; add [groups.NAME]") == 1
    assert (
        reported.count("no safe state: at the end, nodes keep the values") == 4
    )  # at the start, and after each reload
    assert reported.count("sqlite: ") == 0  # an output that the file does not have any more


def test_a_reload_with_an_error_changes_nothing_and_the_next_one_counts(
    file: Path, reported: Reports, tmp_path: Path
) -> None:
    text = file.read_text()
    tokens = tmp_path / "tokens"
    listen = f'[service]\nlisten = "127.0.0.1:0"\ntoken_file = "{tokens}"\n[service.tokens.hmi]\nrole = "read"\n'

    async def story(running: Running, reload: Callable[[], Awaitable[None]]) -> None:
        for wrong in (
            text.replace("[nodes.winder]", "[nodes.winder"),
            text.replace('"winder/force"', '"winder/farce"'),
            text.replace("57600", "9600"),
            text + listen,
        ):
            write(file, wrong)
            await reload()
            assert [group.name for group in running.watch.groups] == ["fast"]
        os.unlink(file)
        await reload()
        assert reported.count("reload failed, nothing was changed: ") == 5
        write(file, text)
        await reload()
        assert reported.count("was reloaded") == 1

    on_a_run(file, story)
    assert reported.level_of("reload failed") is Level.ERROR
    assert reported.count("reload failed") == 5


def test_a_reload_takes_the_tokens_of_the_file_again(file: Path, reported: Reports, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text("hmi a-token-of-the-hmi-0001\n")
    tokens.chmod(0o600)
    file.write_text(
        f'{file.read_text()}\n[service]\nlisten = "127.0.0.1:0"\ntoken_file = "{tokens}"\n'
        '[service.tokens.hmi]\nrole = "read"\n'
    )

    async def story(running: Running, reload: Callable[[], Awaitable[None]]) -> None:
        await reload()
        before = dict(running.line.authorisation.access.secrets)
        assert before.keys() == {"hmi"}
        write(tokens, "hmi a-token-of-the-hmi-0002\n")
        await reload()
        after = running.line.authorisation.access.secrets
        assert after.keys() == {"hmi"}
        assert after != before

    on_a_run(file, story)
    assert reported.count(" and tcp://127.0.0.1:") == 1  # where it is served, too


def test_all_safe_writes_are_named_at_the_start_and_sent_once_at_the_end(
    file: Path, reported: Reports, three_controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = f'[outputs.jsonl]\npath = "{file.parent}/line.jsonl"\n'
    file.write_text(file.read_text() + second + SAFE)
    entered: list[str] = []

    async def story(running: Running, reload: Callable[[], Awaitable[None]]) -> None:
        state, enter = running.line.safe_state, running.line.safe_state.enter

        async def counted(authorisation: Any, why: str) -> Any:
            entered.append(why)
            return await enter(authorisation, why)

        monkeypatch.setattr(type(state), "enter", lambda self, *arguments: counted(*arguments))

    running = on_a_run(file, story)
    assert running.left_safely
    assert entered == ["end of run"]
    assert reported.count("safe state at the end: winder/force = 1.5, winder/11 = 2 within 7 s") == 1
    assert reported.count("safe state confirmed: winder/force, winder/11") == 1
    assert [reported.count(f"{output}: ") for output in ("sqlite", "jsonl")] == [1, 1]


def test_a_safe_state_that_is_not_confirmed_is_remembered(
    file: Path, reported: Reports, three_controllers: TcpServer
) -> None:
    file.write_text(file.read_text() + SAFE.replace("7.0", "0.2"))

    async def story(running: Running, reload: Callable[[], Awaitable[None]]) -> None:
        three_controllers.call(lambda line, now: line.cut(now, line.device(1)))

    assert not on_a_run(file, story).left_safely
    assert reported.count("not confirmed: ") == 2
    assert reported.count("safe state confirmed") == 0
    assert reported.level_of("not confirmed") is Level.CRITICAL


# parts of it


def test_what_ends_the_run_is_named() -> None:
    running: Any = SimpleNamespace(_ending=None)
    assert Running._why(running) == "end of run"
    running._ending = SimpleNamespace(number=0)
    assert Running._why(running) == "end of run"
    running._ending.number = signal.SIGTERM
    assert Running._why(running) == "SIGTERM"


@pytest.mark.parametrize(
    ("errors", "level"),
    [(("", ""), Level.NOTICE), (("", "disk full"), Level.WARNING), (("disk full", ""), Level.WARNING)],
)
def test_an_event_of_an_output_is_a_warning_while_any_output_is_down(errors: tuple[str, ...], level: Level) -> None:
    counts = [OutputStatistics("csv", "written", 0, 0, 0, error) for error in errors]
    reported = Reports()
    running: Any = SimpleNamespace(
        line=SimpleNamespace(outputs=SimpleNamespace(statistics=lambda: counts)),
        watch=SimpleNamespace(announce=reported.note),
    )
    Running._print_output_event(running, "csv is down")
    assert reported == [("csv is down", level)]


@pytest.mark.parametrize("free", [True, False])
def test_what_the_service_refused_is_printed_unless_the_screen_shows_it(reported: Reports, free: bool) -> None:
    running: Any = SimpleNamespace(watch=SimpleNamespace(may_print=lambda: free))
    Running._print_refusals(running, "a connection was refused")
    assert reported == [("a connection was refused", Level.WARNING)] * free


@pytest.mark.parametrize(
    ("saved", "groups", "could_learn", "times"),
    [
        (0.006, 1, (False, True), 1),
        (0.004, 1, (True,), 0),
        (0.5, 0, (True,), 0),
        (0.5, 1, (False, False), 0),
    ],
)
def test_what_learned_reply_times_would_save_is_reported_once_if_it_is_worth_it(
    reported: Reports, saved: float, groups: int, could_learn: tuple[bool, ...], times: int
) -> None:
    losses = SimpleNamespace(share=0.01, documented=0.2 + saved, learned=0.2, windows=(0.1, 0.2))

    async def plan() -> Any:
        return SimpleNamespace(losses=losses)

    nodes = {str(number): SimpleNamespace(could_learn=one) for number, one in enumerate(could_learn)}
    line = SimpleNamespace(groups=[None] * groups, file=SimpleNamespace(nodes=nodes), bus=SimpleNamespace(plan=plan))
    running: Any = SimpleNamespace(line=line)
    anyio.run(Running._print_gain_of_learning, running)
    assert reported.count("if 1% of all frames are lost, the schedule needs 21% of the line, and 20%") == times
    assert reported.count("(windows of 100 ms to 200 ms)") == times
    assert len(reported) == times


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        (OutputStatistics("mqtt", "sent", 7, 2, 0, ""), "mqtt: 7 sent, 2 dropped"),
        (
            OutputStatistics("mqtt", "sent", 7, 2, 5, "", spilled=4),
            "mqtt: 7 sent, 2 dropped, 4 kept on disk for the next run",
        ),
        (
            OutputStatistics("mqtt", "sent", 7, 2, 5, "no route", spilled=4, suppressed=3),
            "mqtt: 7 sent, 2 dropped, 3 suppressed, 4 kept on disk for the next run, down: no route",
        ),
    ],
)
def test_the_counts_of_an_output_are_one_line(counts: OutputStatistics, text: str) -> None:
    assert output_text(counts) == text
