"""The README's two lines name what exists, its programs use public names; the examples run."""

from __future__ import annotations

import ast
import asyncio
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

import busmaster
from busmaster import Hcp2Controller, MemoryPort
from busmaster.emulator.line import Line
from busmaster.registry import make_device
from busmaster.testing import answers_of, run_in_virtual_time
from tests.docs.pages import ROOT, Block, blocks
from tests.patience import PATIENCE
from tests.tiers import one_by_default

README = ROOT / "README.md"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXAMPLES = sorted(
    (path for path in (ROOT / "examples").glob("*.py") if path.name[0] != "_"),
    key=lambda path: (not path.stem.endswith("hello"), path.name),  # the first runs by default: a quick one
)


def two_lines() -> list[str]:
    return blocks(README)[0].text.splitlines()


def test_the_first_block_is_two_lines_that_set_up_and_show_and_set_up_and_test() -> None:
    demo, tests = two_lines()
    assert demo.endswith("busmaster demo")
    assert tests.endswith("python -m pytest -n auto")
    for line in (demo, tests):
        steps = line.split(" && ")
        assert steps[0] == "python3 -m venv .venv"
        assert all(shlex.split(step)[0].startswith(".venv/bin/") for step in steps[1:])


def test_the_two_lines_install_extras_that_exist() -> None:
    for line in two_lines():
        [extras] = re.findall(r"'\.\[([\w,]+)\]'", line)
        assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])


def test_the_console_script_is_there() -> None:
    module, _, name = PROJECT["scripts"]["busmaster"].partition(":")
    assert callable(getattr(__import__(module, fromlist=[name]), name))


@pytest.mark.parametrize("block", blocks(README, "python"), ids=lambda block: str(block.place))
def test_a_program_in_the_readme_imports_public_names_alone(block: Block) -> None:
    for node in ast.walk(ast.parse(block.text)):
        if isinstance(node, ast.ImportFrom) and node.module == "busmaster":
            assert {alias.name for alias in node.names} <= set(busmaster.__all__)


def test_the_program_in_the_readme_writes_and_polls(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)])
    monkeypatch.setattr(busmaster, "SerialPort", lambda path, *, baudrate: MemoryPort(line))
    [block] = blocks(README, "python")
    program: dict[str, Any] = {"__name__": "readme"}
    exec(block.text, program)
    with pytest.raises(TimeoutError):
        run_in_virtual_time(asyncio.wait_for(program["main"](), timeout=1.0))
    assert answers_of(line.device(5))(bytes.fromhex("07 30 35 02 30 31 05 03"))[3:10] == b"123.456"
    assert len(capsys.readouterr().out.splitlines()) >= 5


@pytest.mark.parametrize("path", one_by_default(EXAMPLES), ids=lambda path: str(path.name))
def test_an_example_runs_by_itself_and_ends(path: Path) -> None:
    done = run([sys.executable, str(path)])
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def run(command: list[str]) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"}
    return subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
