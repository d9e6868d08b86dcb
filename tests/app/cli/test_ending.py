"""Ctrl-C and SIGTERM: the first one ends a command in order, whatever comes with it."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import anyio
import click
import pytest

from busmaster.app.cli import ending as module
from busmaster.app.cli import main
from busmaster.app.cli.emulate import serve_for
from busmaster.app.cli.ending import SIGNALS, Ending, until_ended
from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, started
from tests.patience import PATIENCE

POLL = ("--protocol", "hcp2", "--nodes", "1", "--items", "1", "--period", "0.02")


@pytest.fixture
def ending() -> Iterator[Ending]:
    # All of them: one that was heard leaves them ignored, and so they would be in what a later test starts.
    before = {number: signal.getsignal(number) for number in SIGNALS}
    with Ending() as ending:
        yield ending
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("number", "raised", "second"),
    [
        (signal.SIGINT, KeyboardInterrupt, signal.SIGINT),
        (signal.SIGTERM, SystemExit, signal.SIGTERM),
        (signal.SIGINT, KeyboardInterrupt, signal.SIGTERM),
    ],
)
def test_a_signal_cancels_what_runs_and_a_second_one_does_not_break_its_unwinding(
    ending: Ending, number: signal.Signals, raised: type[BaseException], second: signal.Signals
) -> None:
    steps = []

    async def work() -> None:
        os.kill(os.getpid(), number)
        try:
            await anyio.sleep_forever()
        finally:
            os.kill(os.getpid(), second)
            with anyio.CancelScope(shield=True):
                await anyio.lowlevel.checkpoint()
            steps.append("given back")

    with pytest.raises(raised):
        ending.run(work)
    assert steps == ["given back"]
    assert ending.number == number


def test_a_signal_outside_a_loop_unwinds_the_thread_once(ending: Ending) -> None:
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGINT)
    assert ending.number == signal.SIGINT


@pytest.mark.parametrize("number", SIGNALS)
def test_each_signal_of_users_and_supervisors_unwinds_with_its_status(ending: Ending, number: signal.Signals) -> None:
    raised = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    with pytest.raises(raised) as unwound:
        os.kill(os.getpid(), number)
    if isinstance(unwound.value, SystemExit):
        assert unwound.value.code == 128 + number
    assert {*SIGNALS} >= {signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU}


def test_a_signal_that_comes_again_after_its_patience_ends_the_process_at_once(
    ending: Ending, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[int] = []
    clock = [100.0]
    monkeypatch.setattr(module, "os", SimpleNamespace(_exit=ended.append))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    with pytest.raises(SystemExit):
        ending._heard(signal.SIGTERM, None)
    clock[0] = 100.0 + ending.patience - 0.1
    ending._heard(signal.SIGTERM, None)
    assert ended == []
    clock[0] = 100.0 + ending.patience
    ending._heard(signal.SIGTERM, None)
    assert ended == [143]


def test_a_signal_that_is_ignored_at_the_start_stays_ignored() -> None:
    before = signal.signal(signal.SIGQUIT, signal.SIG_IGN)
    try:
        with Ending():
            assert signal.getsignal(signal.SIGQUIT) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not signal.SIG_IGN
        assert signal.getsignal(signal.SIGQUIT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGQUIT, before)


def test_a_process_that_shuts_down_after_a_signal_ignores_further_ones() -> None:
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        with pytest.raises(KeyboardInterrupt), Ending():
            os.kill(os.getpid(), signal.SIGINT)
        assert {signal.getsignal(number) for number in SIGNALS} == {signal.SIG_IGN}
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_signal_before_the_loop_runs_ends_it_before_its_work(ending: Ending) -> None:
    """As one that is received while the loop is made."""
    worked: list[bool] = []

    async def work() -> None:
        worked.append(True)

    def make() -> asyncio.AbstractEventLoop:
        ending._heard(signal.SIGTERM, None)
        return asyncio.new_event_loop()

    with pytest.raises(SystemExit) as ended:
        ending.run(work, loop_factory=make)
    assert (ended.value.code, worked) == (143, [])


def test_a_signal_after_the_loop_has_ended_unwinds_the_thread_again(ending: Ending) -> None:
    async def work() -> None:
        pass

    ending.run(work)
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("with_ending", [True, False])
def test_what_a_command_runs_gets_its_arguments_and_its_loop(with_ending: bool) -> None:
    made: list[asyncio.AbstractEventLoop] = []

    def make() -> asyncio.AbstractEventLoop:
        made.append(asyncio.new_event_loop())
        return made[-1]

    async def work(*values: int) -> tuple[tuple[int, ...], bool]:
        return values, asyncio.get_running_loop() is made[-1]

    with Ending() as ending, click.Context(click.Command("c"), obj=ending if with_ending else None):
        assert until_ended(work, 1, 2, 3, 4, loop_factory=make) == ((1, 2, 3, 4), True)


def test_without_a_signal_the_result_comes_back_and_the_handlers_are_as_before() -> None:
    before = signal.getsignal(signal.SIGINT)

    async def work(number: int) -> int:
        return number

    with Ending() as ending:
        assert ending.run(work, 7) == 7
    assert signal.getsignal(signal.SIGINT) is before


def test_a_command_in_another_thread_leaves_signals_alone() -> None:
    before = signal.getsignal(signal.SIGINT)
    found = []

    def enter() -> None:
        with Ending():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert found == [before]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_sent_twice_ends_a_poll_with_its_summary(
    controllers: TcpServer, number: signal.Signals, status: int
) -> None:
    with started("poll", controllers.path, *POLL) as process:
        assert process.stdout is not None
        process.stdout.readline()
        for _ in range(3):
            process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == status
    assert "cycles" in err
    assert "Traceback" not in err


def test_a_signal_that_another_thread_takes_ends_an_emulated_line_too() -> None:
    class Heard(BaseException):
        """It was."""

    def hear(*_: object) -> None:
        raise Heard

    def serve() -> None:
        taking.start()
        serve_for(None)

    before = signal.signal(signal.SIGUSR1, hear)
    taking = threading.Timer(0.1, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGUSR1))
    try:
        with pytest.raises(Heard):
            serve()
    finally:
        taking.join()
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["--help", "--version", "read --help"])
def test_a_full_disk_under_a_help_text_is_one_line(arguments: str) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        command = [sys.executable, "-m", "busmaster", *arguments.split()]
        with subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE) as process:
            _, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err.decode()) == (1, "busmaster: No space left on device\n")


def test_a_closed_standard_output_is_no_error_and_standard_error_never_stands_in_for_it(
    busmaster: Command, controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", None)
        quiet = busmaster("read", controllers.path, "--protocol", "hcp2", "--node", "1", "1")
        sys.stdout.close()
    assert (quiet.status, quiet.err) == (0, "")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", None)
        quiet = busmaster("read", controllers.path, "--protocol", "hcp2", "--node", "1", "999")
        sys.stderr.close()
    assert (quiet.status, quiet.out) == (2, "")


class Interrupts:
    """Ctrl-C, at the import of the commands."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "busmaster.app.cli.app":
            raise KeyboardInterrupt


def test_ctrl_c_while_the_program_is_loaded_ends_it_with_its_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", interrupted)
        assert main(["--version"]) == 130
    monkeypatch.delitem(sys.modules, "busmaster.app.cli.app", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupts(), *sys.meta_path])
    assert main(["--version"]) == 130
