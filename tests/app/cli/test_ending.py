"""Ctrl-C and SIGTERM: the first one ends a command in order, whatever comes with it."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import anyio
import pytest

from busmaster.app.cli import main
from busmaster.app.cli.emulate import serve_for
from busmaster.app.cli.ending import SIGNALS, Ending
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


@pytest.mark.parametrize(("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_a_signal_cancels_what_runs_and_a_second_one_does_not_break_its_unwinding(
    ending: Ending, number: signal.Signals, raised: type[BaseException]
) -> None:
    steps = []

    async def work() -> None:
        os.kill(os.getpid(), number)
        try:
            await anyio.sleep_forever()
        finally:
            os.kill(os.getpid(), number)
            with anyio.CancelScope(shield=True):
                await anyio.lowlevel.checkpoint()
            steps.append("given back")

    with pytest.raises(raised):
        ending.run(work)
    assert steps == ["given back"]


def test_a_signal_outside_a_loop_unwinds_the_thread_once(ending: Ending) -> None:
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGINT)
    assert ending.number == signal.SIGINT


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
