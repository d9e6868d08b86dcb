"""The live view as processes on real terminals: attached and detached at will, beside a line that goes on."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from termios import tcgetattr

import pytest

from busmaster.app.cli import top
from busmaster.emulator.serve import TcpServer
from busmaster.errors import LineDown
from tests.app.cli.conftest import SLITTER, Command, owner, serve, started
from tests.app.cli.test_processes import Terminal
from tests.patience import PATIENCE

ON_SCREEN = b"\x1b[?1049h"


@contextmanager
def terminal(*arguments: str, program: tuple[str, ...] = ("-m", "busmaster")) -> Iterator[Terminal]:
    shown = Terminal(*arguments, program=program)
    try:
        yield shown
    finally:
        shown.close()


def draws(shown: Terminal, what: bytes = b"winder") -> None:
    """Wait until the picture has it."""
    shown.until(lambda drawn: what in drawn.partition(ON_SCREEN)[2])


def gave_back(shown: Terminal) -> bool:
    """Whether the terminal is as it was."""
    return b"\x1b[?1049l" in shown.drawn and tcgetattr(shown.slave) == shown.before


@pytest.mark.slow
def test_several_look_at_once_and_each_leaves_alone(file: Path) -> None:
    with owner("serve", str(file)) as (process, _), terminal("top") as first, terminal("top", "slitter") as second:
        draws(first)
        draws(second)
        os.write(first.master, b"q")
        assert first.status() == 0
        assert gave_back(first)
        second.drawn = b""
        draws_on(second)
        os.write(second.master, b"\x03")
        assert second.status() == 130
        assert gave_back(second)
        assert process.poll() is None


def draws_on(shown: Terminal) -> None:
    """Wait for more of the picture: a cycle after another is drawn."""
    shown.until(lambda drawn: len(drawn) > 1000)


ends = pytest.mark.parametrize(("end", "said"), [(signal.SIGTERM, b"has ended"), (signal.SIGKILL, b"was lost")])


@pytest.mark.slow
@ends
def test_while_its_owner_is_away_it_says_so_and_goes_on_when_that_is_back(
    file: Path, end: signal.Signals, said: bytes
) -> None:
    with owner("serve", str(file)) as (process, _), terminal("top", str(file)) as shown:
        draws(shown)
        process.send_signal(end)
        shown.until(lambda drawn: b"its owner is not running" in drawn)
        shown.until(lambda drawn: said in drawn or b"no program serves" in drawn)
        shown.drawn = ON_SCREEN
        with owner("serve", str(file)):
            draws(shown, b"missed")  # of a group: it is drawn anew, as it is of another owner
            os.write(shown.master, b"q")
            assert shown.status() == 0
            assert b"Traceback" not in shown.drawn
            assert gave_back(shown)


@pytest.mark.slow
@ends
def test_the_end_of_the_owner_ends_the_owners_own_view_with_a_sentence(
    file: Path, end: signal.Signals, said: bytes
) -> None:
    with owner("serve", str(file)) as (process, _), terminal("top", str(file), "--of-owner") as shown:
        draws(shown)
        process.send_signal(end)
        assert shown.status() == 1
        shown.until(lambda drawn: said in drawn)
        assert b"Traceback" not in shown.drawn
        assert gave_back(shown)


@pytest.mark.slow
def test_a_line_that_is_lost_is_offline_until_it_is_back(file: Path, three_controllers: TcpServer) -> None:
    with owner("serve", str(file)), terminal("top") as shown:
        draws(shown, b"up")
        three_controllers.close()
        shown.drawn = ON_SCREEN
        draws(shown, b"offline")


@pytest.mark.slow
def test_one_that_is_terminated_gives_the_terminal_back_and_one_without_a_terminal_ends(file: Path) -> None:
    with owner("serve", str(file)) as (process, _):
        with terminal("top") as shown:
            draws(shown)
            shown.process.terminate()
            assert shown.status() == 128 + signal.SIGTERM
            assert gave_back(shown)
        with terminal("top") as gone:
            draws(gone)
            os.close(gone.master)
            gone.process.wait(PATIENCE)
            gone.master = os.open(os.devnull, os.O_RDONLY)
        assert process.poll() is None


@pytest.mark.slow
def test_q_in_the_view_of_a_run_ends_the_run_and_in_another_it_does_not(file: Path) -> None:
    with terminal("run", str(file)) as ours:
        draws(ours)
        with terminal("top") as other:
            draws(other)
            os.write(other.master, b"q")
            assert other.status() == 0
        assert ours.process.poll() is None
        os.write(ours.master, b"q")
        assert ours.status() == 0
        ours.until(lambda drawn: b"fast: " in drawn)
        assert gave_back(ours)


@pytest.mark.slow
def test_a_run_whose_line_is_served_to_nobody_has_its_own_view(busmaster: Command, file: Path) -> None:
    file.write_text(file.read_text() + "[service]\nenabled = false\n")
    with terminal("run", str(file)) as shown:
        draws(shown)
        assert busmaster("status").out == ""
        shown.process.terminate()
        assert shown.status() == 0
        assert gave_back(shown)


NOWHERE = """
import os, sys
from busmaster.app.cli import main
os.environ["TMPDIR"] = sys.argv[1]
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.slow
def test_a_run_whose_view_cannot_be_served_prints_plain_lines(file: Path, tmp_path: Path) -> None:
    file.write_text(file.read_text() + "[service]\nenabled = false\n")
    long = tmp_path / ("x" * 100)
    long.mkdir()
    with terminal(str(long), "run", str(file), program=("-c", NOWHERE)) as shown:
        shown.until(lambda drawn: b"winder/force 0" in drawn)
        assert b"no live view: " in shown.drawn
        assert b"use a shorter path for the socket" in shown.drawn
        shown.process.terminate()
        assert shown.status() == 0


WITHOUT = """
import importlib.util as u, sys
find = u.find_spec
u.find_spec = lambda name, *rest: None if name == "websockets" else find(name, *rest)
sys.modules["websockets"] = None
from busmaster.app.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_run_without_websockets_prints_plain_lines_and_says_what_to_install(file: Path) -> None:
    with terminal("run", str(file), program=("-c", WITHOUT)) as shown:
        shown.until(lambda drawn: b"winder/force 0" in drawn)
        assert b"the live view needs an extra: pip install 'busmaster[service]'; showing plain lines" in shown.drawn
        shown.process.terminate()
        assert shown.status() == 0


def test_top_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(top, "find_spec", lambda name: None)
    assert top.what_is_missing() == "an extra: pip install 'busmaster[tui,service]'"


@pytest.mark.slow
def test_top_without_a_terminal_is_wrong_usage(file: Path) -> None:
    with owner("serve", str(file)), started("top", "slitter") as process:
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert err.startswith("busmaster: top needs a terminal")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "said"), [("nobody", "no running line named 'nobody' "), ("unix:/nobody", "no program serves ")]
)
def test_that_there_is_no_such_line_is_said_before_that_there_is_no_terminal(line: str, said: str) -> None:
    with started("top", line) as process:
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert err.startswith(f"busmaster: {said}")


@pytest.mark.slow
def test_a_line_is_meant_by_its_name_its_file_its_port_or_its_address(
    file: Path, tmp_path: Path, three_controllers: TcpServer
) -> None:
    with pytest.raises(LineDown, match="busmaster run"):
        top.address_of(str(file))
    with owner("serve", str(file)) as (_, address):
        other_name = tmp_path / "other.toml"
        other_name.write_text(file.read_text())
        port = three_controllers.path.removeprefix("socket://")
        for meant in ("slitter", str(file), str(other_name), three_controllers.path, port, address, None):
            assert top.address_of(meant) == address
    assert top.address_of("unix:/x") == "unix:/x"
    assert top.address_of("nobody") == "nobody"


@pytest.mark.slow
def test_top_names_the_lines_where_several_run_and_says_where_none_does(file: Path, tmp_path: Path) -> None:
    with terminal("top") as shown:
        assert shown.status() == 1
        assert b"no running line of this user; start one with: busmaster run LINE.toml" in shown.drawn
    with serve("hcp2", 1, 2, 3) as second:
        other = tmp_path / "winder.toml"
        other.write_text(SLITTER.replace("PORT", second.path).replace("FOLDER", str(tmp_path)))
        with owner("serve", str(file)), owner("serve", str(other)), terminal("top") as shown:
            assert shown.status() == 2
            assert b"several lines are running; name one of slitter, winder" in shown.drawn
