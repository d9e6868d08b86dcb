"""The examples of the pages that change the package: the changes are made in a copy of it, where their tests pass."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

PAGES = {
    "adding-a-rule.md": ["tests/arbiter/bench.py"],
    "adding-a-command.md": ["tests/app/cli/test_command_line.py", "tests/docs/command_line.py"],
}
"""Files besides the package that a page changes or uses."""
BLOCK = re.compile(r"^ *```(?:py|text)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
FIRST = re.compile(r"# (?P<file>\S+?)(?:, before: (?P<anchor>.*))?\n")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_example_works_as_the_page_shows_it(page: str, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "busmaster", tmp_path / "busmaster", ignore=shutil.ignore_patterns("__pycache__"))
    for file in PAGES[page]:
        (tmp_path / file).parent.mkdir(parents=True)
        shutil.copy(ROOT / file, tmp_path / file)
    added: list[Path] = []
    for block in BLOCK.findall((ROOT / "docs" / page).read_text()):
        code = textwrap.dedent(block)
        head = FIRST.match(code)
        assert head is not None, code
        path, rest = tmp_path / head["file"], code[head.end() :]
        if head["anchor"] is None:
            path.write_text(rest)
            added.append(path)
            continue
        line = re.search(rf"^( *){re.escape(head['anchor'])}$", text := path.read_text(), re.MULTILINE)
        assert line is not None, f"{head['file']} has no line {head['anchor']!r}"
        path.write_text(text[: line.start()] + textwrap.indent(rest, line[1]) + text[line.start() :])
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(tmp_path),
        *map(str, added),
    ]
    done = subprocess.run(command, check=False, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout
