"""The README's two lines name what exists, its programs use public names; the examples run."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import busmaster
from tests.docs.pages import ROOT, Block, blocks
from tests.patience import PATIENCE

README = ROOT / "README.md"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py") if path.name[0] != "_")


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


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
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
