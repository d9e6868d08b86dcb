"""The commands that a page shows, run in their order in one folder; their output is held against the page's."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp

import click

from busmaster.app.cli.app import cli
from tests.docs.pages import ROOT, Block
from tests.patience import PATIENCE
from tests.ports import free_port
from tests.printed import Printed

ADDRESS = re.compile(r"\b(127\.0\.0\.1|localhost):(\d{4,5})\b")
PORT_KEY = re.compile(r"^(port = )(\d{4,5})$", re.MULTILINE)
NUMBER = r"(?<![\d.])[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"
OWN_BINDS = {
    name: str(option.default)
    for name in cli.list_commands(click.Context(cli, **cli.context_settings))
    if (command := cli.get_command(click.Context(cli, **cli.context_settings), name)) is not None
    for option in command.params
    if option.name == "bind"
}
"""Where interfaces listen that are not told: another program of this machine may be there."""
CTRL_C = "^C"


@dataclass(frozen=True, slots=True)
class Command:
    """One command of a block, the output shown below it, and where it stands."""

    text: str
    shown: str
    place: str
    goes_on: bool
    vary: bool


def commands(block: Block) -> Iterator[Command]:
    """The commands of a block: behind `$ ` in `console`, else one a line."""
    texts = list(_texts(block))
    for number, (text, shown) in enumerate(texts):
        ends = number + 1 == len(texts)
        goes_on = text.endswith(" &") or CTRL_C in shown.splitlines() or (ends and block.said("goes on") is not None)
        place = f"{block.place}: {text}"
        yield Command(text.removesuffix(" &"), shown, place, goes_on, block.said("numbers vary") is not None)


def joined(block: Block) -> str:
    r"""The text of a block of commands, with the lines joined that end in a \."""
    return re.sub(r"\\\n\s*", "", block.text)


def _texts(block: Block) -> Iterator[tuple[str, str]]:
    if block.language == "console":
        for found in re.finditer(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", joined(block), re.MULTILINE):
            yield found[1], found[2]
        return
    for line in joined(block).splitlines():
        if line and not line.startswith("#"):  # bash knows a remark behind a command
            yield line, ""


def pattern_of(shown: str, vary: bool) -> str:
    """What matches the output that a page shows: blanks are alike, `...` is anything, and numbers, if they vary."""
    special = rf"(\.\.\.|{NUMBER})" if vary else r"(\.\.\.)"
    lines = tidy(shown).splitlines()
    return "".join(r"(?:.*\n)*?" if line == "..." else f"{_pattern_of(line, special)}\n" for line in lines)


def _pattern_of(line: str, special: str) -> str:
    pieces = re.split(special, line)
    pieces[1::2] = [".*?" if piece == "..." else NUMBER for piece in pieces[1::2]]
    pieces[::2] = map(re.escape, pieces[::2])
    return "".join(pieces)


def tidy(output: str) -> str:
    """The output as it is compared: blanks alike, lines without blanks at their ends, no empty lines at its ends."""
    lines = [" ".join(line.split()) for line in output.splitlines()]
    return "".join(f"{line}\n" for line in "\n".join(lines).strip("\n").splitlines())


class Running:
    """A command that runs, and what it has said so far, standard error among it."""

    def __init__(self, command: list[str], folder: Path, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            text=True,
            bufsize=1,
        )
        assert self.process.stdout is not None
        self._printed = Printed(self.process.stdout)

    @property
    def output(self) -> str:
        return "".join(f"{text}\n" for text in self._printed.texts())

    def await_lines(self, shown: str, vary: bool, replace: Replacing) -> bool:
        """Wait until it has said each line that is shown, or any where none is; False where they do not come.

        In whatever order: what goes on says things from more than one source.
        """
        patterns = [re.compile(pattern_of(line, vary)) for line in shown.splitlines() if line != "..."]

        def said() -> bool:
            lines = tidy(replace.shown(self.output)).splitlines(keepends=True)
            return bool(lines) and all(any(map(pattern.fullmatch, lines)) for pattern in patterns)

        return self._printed.wait_for(said)

    def interrupt(self) -> int:
        """End it as Ctrl-C does, and return its exit status, when all that it said is read."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
        return self.wait()

    def wait(self) -> int:
        """Wait until it has ended, and return its exit status, when all that it said is read."""
        try:
            status = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            raise
        finally:
            self._printed.join()
        return status


class Replacing:
    """What stands for something else while a page runs: ports of emulated lines, and addresses that are free here."""

    def __init__(self) -> None:
        self._devices: dict[str, str] = {}
        self._paths: dict[str, str] = {}
        self._ports: dict[str, str] = {}

    def device(self, shown: str, link: Path) -> None:
        """Have a link stand for a device of the page. It is there."""
        self._devices[shown] = str(link)
        self._paths |= {str(link): shown, os.path.realpath(link): shown}

    def real(self, text: str) -> str:
        """Return what the page says, as it is here."""
        for shown, real in self._devices.items():
            text = re.sub(rf"(?<![\w/]){re.escape(shown)}(?!\w)", real, text)
        text = ADDRESS.sub(lambda found: f"{found[1]}:{self._port(found[2])}", text)
        return PORT_KEY.sub(lambda found: found[1] + self._port(found[2]), text)

    def _port(self, shown: str) -> str:
        if shown not in self._ports:
            self._ports[shown] = str(free_port())
        return self._ports[shown]

    def shown(self, text: str) -> str:
        """Return what is so here, as the page says it."""
        for real, shown in [*self._paths.items(), *((real, shown) for shown, real in self._ports.items())]:
            text = re.sub(rf"(?<![\w/]){real}(?!\w)", shown, text)
        return text


class Shell:
    """Runs the commands of one page. Use it in `with`: leaving ends what goes on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "page"
        self.replace = Replacing()
        self._programs = folder / "bin"
        self._run_time = Path(mkdtemp(prefix="busmaster-"))  # short: the path of a socket has 107 characters at most
        for path in (self.folder, self._programs):
            path.mkdir()
        self._program("busmaster", f'exec {shlex.quote(sys.executable)} -m busmaster "$@"')
        for name in ("python", "python3"):
            self._program(name, f'exec {shlex.quote(sys.executable)} "$@"')
        self._leaving = ExitStack()
        self._leaving.callback(shutil.rmtree, self._run_time)
        self._status = 0

    def _program(self, name: str, text: str) -> None:
        path = self._programs / name
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    def __enter__(self) -> Shell:
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving.close()

    @property
    def environment(self) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.startswith("BUSMASTER_")}
        return kept | {
            "PATH": f"{self._programs}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "PYTHONUNBUFFERED": "1",
            "XDG_RUNTIME_DIR": str(self._run_time),
            "HOME": str(self.folder),
            "LC_ALL": "C.UTF-8",
            "TZ": "UTC",
            "COLUMNS": "100",
        }

    def write(self, name: str, text: str) -> None:
        """Write a file of the page."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.replace.real(text))

    def emulate(self, port: str, drives: str) -> None:
        """Have a line emulated at what the page calls so: a device, or a TCP port."""
        place = f"the emulated line of {port}"
        if port.startswith("socket://"):
            self._start(f"busmaster emulate {drives} --tcp {port.removeprefix('socket://')}", place)
            return
        link = self._run_time / port.replace("/", "-")
        self._start(f"busmaster emulate {drives} --pty {link}", place)
        self.replace.device(port, link)

    def run(self, command: Command) -> None:
        """Run a command, and hold its output against what the page shows."""
        if command.text != "echo $?":
            self.check_status(f"before {command.place}")
        if command.goes_on:
            self._start(command.text, command.place, command)
            return
        running = Running(self._bash(command.text), self.folder, self.environment)
        self._status = running.wait()
        if command.shown:
            self._hold(command, command.shown, running.output)

    def check_status(self, place: str) -> None:
        """Hold that the last command ended with 0, or that its status was shown."""
        assert self._status == 0, f"{place}: exit status {self._status}"

    def _bash(self, text: str) -> list[str]:
        for interface, address in OWN_BINDS.items():
            if "--bind" not in text:
                text = re.sub(rf"\bbusmaster {interface}\b", f"busmaster {interface} --bind {address}", text)
        return ["bash", "-c", f"(exit {self._status}); {self.replace.real(text)}"]

    def _start(self, text: str, place: str, command: Command | None = None) -> None:
        """Start what goes on, and wait until it has said what is shown of it; end it where that is shown."""
        going = Running(self._bash(text), self.folder, self.environment)
        self._leaving.callback(going.interrupt)
        shown, ends, after = (command.shown if command else "").partition(f"{CTRL_C}\n")
        vary = command is not None and command.vary
        found = going.await_lines(shown, vary, self.replace)
        assert found, f"{place}\nis to say\n{shown}\nbut says\n{self.replace.shown(going.output)}"
        if command and ends:
            going.interrupt()
            if after:
                self._hold(command, shown + after, going.output)

    def _hold(self, command: Command, shown: str, output: str) -> None:
        said = self.replace.shown(output)
        found = re.fullmatch(pattern_of(shown, command.vary), tidy(said))
        assert found, f"{command.place}\nis to say\n{shown}\nbut says\n{said}"
