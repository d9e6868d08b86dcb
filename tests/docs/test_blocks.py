"""Every block of code on a page is run, or held against what it is of: programs, commands with their output, files."""

from __future__ import annotations

import grp
import importlib.util
import json
import pwd
import re
import shutil
import sys
import tomllib
import zlib
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import click
import pytest
from jsonschema import Draft202012Validator

from busmaster.app.cli.app import cli
from busmaster.app.config.schema import json_schema
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from tests.docs.pages import PAGES, ROOT, Block, Mark, blocks, name_of, parts, prose
from tests.docs.shell import Shell, commands, joined

BASE = Path(__file__).parent / "base.toml"
COMMANDS = ("console", "sh")
SHOWN = ("text", "ini", "yaml", "lua", "csv", "telegrams", "py")
"""What is not run: drawings, files of other programs, signatures (`py`). test_telegrams.py has the telegrams."""


def needed(block: Block) -> bool:
    """Whether what the block needs is there: a module, or a program."""
    name = block.said("needs")
    return name is None or bool(importlib.util.find_spec(name) or shutil.which(name))


class Page:
    """One page, run from top to bottom."""

    def __init__(self, page: Path, folder: Path) -> None:
        self.page = page
        self.shell = Shell(folder)
        self.program: list[str] = []
        self._whole = tomllib.loads(BASE.read_text())

    def run(self) -> None:
        for part in parts(self.page):
            for mark in part.marks if isinstance(part, Block) else (part,):
                self._mark(mark, part if isinstance(part, Block) else None)
            if isinstance(part, Block) and needed(part):
                self._block(part)
        self.shell.check_status(f"the last command of {name_of(self.page)}")

    def _mark(self, mark: Mark, block: Block | None) -> None:
        if mark.name == "file" and (block or mark.text):
            self.shell.write(mark.about, (ROOT / mark.text).read_text() if mark.text else block.text if block else "")
        elif mark.name == "line":
            self.shell.emulate(mark.about, mark.text)

    def _block(self, block: Block) -> None:
        match block.language:
            case "python" if block.said("file") is None:
                self.program.append(block.text)
            case "toml":
                self._toml(block)
            case "json":
                check_json(block)
            case language if language in COMMANDS and block.said("not run") is None:
                for command in commands(block):
                    self.shell.run(command)

    def _toml(self, block: Block) -> None:
        """Hold a table against what it is: a LINE.toml, or a piece of one, a template, or a package's."""
        data = tomllib.loads(block.text)
        if "project" in data:
            return
        source = Source(block.place, block.text)
        if "points" in data:
            for protocol in [data["protocol"]] if isinstance(data["protocol"], str) else data["protocol"]:
                self.shell.write("template.toml", block.text)
                node = {"protocol": protocol, "address": 1, "template": str(self.shell.folder / "template.toml")}
                source.data = {"port": "/dev/ttyUSB0", "nodes": {"node": node}}
                ConfiguredLine(read(source))
            return
        if "port" in data and "nodes" in data:
            self._whole = data
        source.data = merged(self._whole, data)
        ConfiguredLine(read(source), outputs=False)
        whole_file().validate(source.data)


@cache
def whole_file() -> Draft202012Validator:
    """The schema of a LINE.toml, which takes as long to make as a page to read."""
    return Draft202012Validator(json_schema())


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """A table over another, key by key."""
    both = {**base, **over}
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            both[key] = merged(base[key], value)
    return both


def check_json(block: Block) -> None:
    """Hold that it is JSON: one value, or one a line."""
    try:
        json.loads(block.text)
    except ValueError:
        for line in block.text.splitlines():
            json.loads(line)


def has_commands(page: Path) -> bool:
    return any(block.language in COMMANDS and block.said("not run") is None for block in blocks(page))


@pytest.fixture(autouse=True)
def _every_name_is_of_a_user_and_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have users and groups that a page names, which this machine need not have."""
    monkeypatch.setattr(pwd, "getpwnam", lambda name: SimpleNamespace(pw_uid=zlib.crc32(name.encode())))
    monkeypatch.setattr(grp, "getgrnam", lambda name: SimpleNamespace(gr_gid=zlib.crc32(name.encode())))


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] * has_commands(page), id=name_of(page)) for page in PAGES]
)
def test_what_a_page_shows_is_so(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs are run as a module, so that what stands under `if __name__ == "__main__"` (a real port) is not."""
    whole = Page(page, tmp_path)
    with whole.shell:
        whole.run()
        module = ModuleType("page")
        monkeypatch.setitem(sys.modules, "page", module)  # dataclasses look there
        monkeypatch.chdir(whole.shell.folder)
        program = whole.shell.replace.real("\n".join(whole.program))
        exec(compile(program, name_of(page), "exec"), vars(module))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_is_of_a_language_that_is_run_or_shown(page: Path) -> None:
    known = {*COMMANDS, *SHOWN, "python", "toml", "json"}
    assert [block.place for block in blocks(page) if block.language not in known] == []


def said_of_busmaster(page: Path) -> list[str]:
    """The commands of busmaster that a page names, run or not: in blocks, and in `backquotes`."""
    lines = [line for block in blocks(page) if block.language in COMMANDS for line in joined(block).splitlines()]
    lines += [text for text in re.findall(r"`([^`]+)`", prose(page)) if text.startswith("busmaster ")]
    return [found for line in lines for found in re.findall(r"(?:^|[\s/])busmaster ([a-z-][^|&;#]*)", line)]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_that_a_page_names_have_the_options_that_it_gives_them(page: Path) -> None:
    for text in said_of_busmaster(page):
        name, *words = text.split()
        context = click.Context(cli, **cli.context_settings)
        command = cli if name.startswith("-") else cli.get_command(context, name)
        if isinstance(command, click.Group) and command is not cli and words:
            command = command.get_command(context, words[0])
        assert command is not None, f"there is no command {text!r}"
        known = {option for parameter in command.get_params(context) for option in parameter.opts}
        options = {word.partition("=")[0] for word in [name, *words] if re.match("--[a-z]", word)}
        assert options <= known, f"busmaster {text}: {options - known}"
