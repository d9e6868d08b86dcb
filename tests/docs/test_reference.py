"""The reference, the manual page and the completions are those of today's program."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from busmaster.app.cli.app import COMMANDS
from tests.docs.command_line import ENVIRONMENT, EXAMPLES, commands
from tests.docs.pages import ROOT
from tests.docs.reference import FILES
from tests.patience import PATIENCE

MANUAL = ROOT / "share" / "man" / "man1" / "busmaster.1"
COMPLETIONS = {
    "bash": ROOT / "share" / "bash-completion" / "completions" / "busmaster",
    "zsh": ROOT / "share" / "zsh" / "site-functions" / "_busmaster",
    "fish": ROOT / "share" / "fish" / "vendor_completions.d" / "busmaster.fish",
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_made_of_the_program_is_that_of_today(name: str) -> None:
    assert (ROOT / name).read_text() == FILES[name](), "write it: python -m tests.docs.reference"


def test_every_command_has_an_example() -> None:
    assert list(EXAMPLES) == [command.name for command in commands() if command.name.split()[0] in COMMANDS]
    assert [command.name for command in commands() if not command.examples] == ["params"]


def test_every_variable_of_our_own_is_in_the_reference() -> None:
    read = {
        name
        for path in (ROOT / "busmaster").rglob("*.py")
        for name in re.findall(r"BUSMASTER_[A-Z]+", path.read_text())
    }
    assert read <= set(ENVIRONMENT)


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
def test_the_manual_page_is_roff_without_a_warning() -> None:
    done = subprocess.run(
        ["groff", "-ww", "-man", "-Tutf8", "-z", str(MANUAL)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


# completion


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """One in which `busmaster` is this one."""
    program = tmp_path / "busmaster"
    program.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m busmaster "$@"\n')
    program.chmod(0o755)
    return os.environ | {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "TERM": "dumb"}


@pytest.mark.parametrize("shell", COMPLETIONS)
def test_a_completion_has_the_program_say_what_its_shell_does(shell: str, environment: dict[str, str]) -> None:
    [asked] = re.findall(r"(?m)^[^#\n]*_BUSMASTER_COMPLETE=(\w+) busmaster", COMPLETIONS[shell].read_text())
    assert asked == f"{shell}_source"
    done = subprocess.run(
        ["busmaster"],
        env=environment | {"_BUSMASTER_COMPLETE": asked},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert f"{shell}_complete" in done.stdout, done.stderr


def typed(command: list[str], environment: dict[str, str], keys: list[tuple[bytes, Callable[[bytes], bool]]]) -> bytes:
    """What a shell on a terminal shows, when each of these is typed as soon as it shows what goes before."""
    on_a_terminal = [sys.executable, "-c", "import pty, sys; pty.spawn(sys.argv[1:])", *command]
    shown = b""
    with subprocess.Popen(
        on_a_terminal, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    ) as shell:
        assert shell.stdin is not None
        assert shell.stdout is not None
        try:
            for text, awaited in keys:
                while not awaited(shown):
                    more = os.read(shell.stdout.fileno(), 4096)
                    assert more, shown
                    shown += more
                shell.stdin.write(text)
                shell.stdin.flush()
        finally:
            os.killpg(shell.pid, signal.SIGKILL)
    return shown


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_a_command(environment: dict[str, str]) -> None:
    shell = ["bash", "--norc", "--noprofile", "-i"]
    prompt = environment | {"PS1": "ready> ", "INPUTRC": "/dev/null", "HISTFILE": "/dev/null"}
    load = f"source {COMPLETIONS['bash']}; echo load''ed\n".encode()
    shown = typed(
        shell,
        prompt,
        [
            (load, lambda shown: b"ready> " in shown),
            (b"busmaster re\t\t", lambda shown: b"\nloaded" in shown and shown.endswith(b"ready> ")),
            (b"\x15", lambda shown: re.search(rb"read +replay", shown) is not None),
        ],
    )
    assert re.search(rb"busmaster re[^\n]*\n *read +replay", shown), shown


def test_the_wheel_brings_them_where_the_system_looks() -> None:
    built = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    folders = [ROOT / folder for folder, to in built["shared-data"].items() if folder == to]
    files = {
        path.relative_to(ROOT / "share").as_posix()
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file()
    }
    assert files == {
        "man/man1/busmaster.1",
        "bash-completion/completions/busmaster",
        "zsh/site-functions/_busmaster",
        "fish/vendor_completions.d/busmaster.fish",
    }
