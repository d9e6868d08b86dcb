"""The command line as it is promised, held against what there is: no command, argument or option more or less."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import click
import pytest

from busmaster.app.cli.app import cli
from busmaster.emulator.serve import TcpServer
from busmaster.registry import kinds
from tests.app.cli.conftest import Command, serve

SIDE = "FILE.toml|NODE@PORT|NODE@LINE.toml"
PROMISED = {
    "demo": "[--seconds S] [--plain]",
    "read": "PORT|LINE.toml [--protocol P] [--node N] ITEM... [--json]",
    "write": "PORT|LINE.toml [--protocol P] [--node N] ITEM=VALUE[,VALUE...]|ITEM=@FILE... [--verify] [--json]"
    " [--decimals N]",
    "do": "NODE@PORT|NODE@LINE.toml ACTION [NUMBER]... [--protocol P] [--within S] [--at-least S] [--json]",
    "poll": "PORT --protocol P [--nodes N-M,K] --items ITEM,ITEM... --period S [--seconds S] [--json] [--plain]",
    "trend": "PORT|LINE.toml NODE/ITEM... [--protocol P] [--period S] [--csv FILE] [--span S] [--seconds S] [--plain]"
    " [--json]",
    "scan": "PORT --protocol P [--nodes N-M,K] [--json]",
    "emulate": "[LINE.toml] [--protocol P] [--nodes N-M,K] [--pty [LINK]] [--tcp HOST:PORT] [--baud N] [--paced]"
    " [--reply-delay MS[-MS]] [--fault NAME=VALUE] [--seed N] [--seconds S]",
    "run": "LINE.toml [--seconds S] [--plain] [--json] [--read-only]",
    "check": "LINE.toml [--json] [--schema]",
    "migrate": "LINE.toml [--write]",
    "plan": "LINE.toml [--json]",
    "monitor": "PORT|LINE.toml [--protocol P] [--json]",
    "doctor": "PORT [--protocol P] [--nodes N-M,K] [--json]",
    "bench": "[PORT] [--protocol P] [--nodes N-M,K] [--seconds S] [--callers N] [--every S] [--priorities NAME=N,...]"
    " [--period S] [--items ITEM,ITEM...] [--reply-delay MS[-MS]] [--fault NAME=VALUE] [--seed N] [--virtual] [--json]"
    " [--plot FILE] [--budget FIGURE=LIMIT] [--compare A.json B.json]",
    "replay": "CAPTURE [--json]",
    "serve": "LINE.toml [--read-only]",
    "status": "[--json]",
    "top": "[LINE|unix:PATH|PORT] [--read-only]",
    "web": "[LINE|unix:PATH|PORT] [--bind HOST:PORT] [--read-only]",
    "opcua": "[LINE|unix:PATH|PORT] [--bind HOST:PORT] [--read-only]",
    "modbus-tcp": "[LINE|unix:PATH|PORT] [--bind HOST:PORT] [--read-only]",
    "safe": "LINE.toml",
    "points": "LINE.toml [--csv] [--from CSV]",
    "items": "PROTOCOL [WORD]... [--json]",
    "discover": "PORT [--yes] [--output LINE.toml]",
    "params": "",
    "params save": "PORT|LINE.toml [--protocol P] [NODE] --output FILE.toml [--items ITEM,ITEM...]",
    "params diff": f"{SIDE} {SIDE} [--protocol P] [--items ITEM,ITEM...] [--json]",
    "params load": "FILE.toml NODE@PORT|NODE@LINE.toml [--protocol P] [--dry-run] [--yes] [--enabled]"
    " [--undo FILE.toml]",
}
"""What follows each command; options in brackets may be left out."""
CAPTURE = "[--capture FILE] [--capture-mb MB] [--capture-files N]"
LINE = "[--baud N] [--echo] [--timeout MS]"
NODE = f"{LINE} [--retries N] [--address-step N]"
BESIDE = {
    "read": f"{CAPTURE} {NODE} [--chain]",
    "write": f"{CAPTURE} {NODE}",
    "do": f"{CAPTURE} {NODE}",
    "poll": f"{CAPTURE} {NODE} [--read-only]",
    "trend": f"{CAPTURE} {NODE}",
    "scan": f"{CAPTURE} {NODE}",
    "run": f"{CAPTURE} [--port PORT]",
    "monitor": f"{CAPTURE} [--baud N]",
    "doctor": f"{CAPTURE} {LINE}",
    "serve": f"{CAPTURE} [--port PORT] [--seconds S]",
    "web": "[--token-file FILE] [--host NAME] [--history FILE]",
    "opcua": "[--allow POINT] [--token-file FILE] [--certificate FILE] [--key FILE] [--trusted FOLDER]",
    "modbus-tcp": "[--map FILE] [--print-map] [--type TYPE] [--last] [--allow POINT] [--pass-through]"
    " [--allow-unit ID] [--allow-from ADDRESS] [--idle SECONDS]",
    "safe": f"{CAPTURE} [--port PORT]",
    "bench": NODE,
    **dict.fromkeys(("params save", "params diff", "params load"), f"{CAPTURE} {NODE}"),
    "discover": f"{CAPTURE} [--protocol P] [--nodes N-M,K]",
}
"""What a line, a node, a recording or an interface takes besides."""
SPOKEN = {"hcp", "hcp2", "microflex", "msc", "mentor", "dc104", "modbus", "ct-ansi"}


def promised(name: str) -> set[str]:
    """The words behind a command, an option with its value as one."""
    text = f"{PROMISED[name]} {BESIDE.get(name, '')}"
    return set(re.findall(r"\[--[a-z-]+(?: \[?[^\s\]]+(?:\[-MS\])?\]?(?: [^\s\[\]]+)?)?\]|--[a-z-]+ \S+|\S+", text))


def found(name: str) -> Iterator[str]:
    """The same words, of the command as it is."""
    context = click.Context(cli, **cli.context_settings)
    command: click.Command | None = cli
    for part in name.split():
        assert isinstance(command, click.Group)
        command = command.get_command(context, part)
    assert command is not None
    for parameter in command.get_params(context):
        word = parameter.make_metavar(context)
        if isinstance(parameter, click.Option):
            long = max(parameter.opts, key=len)
            word = long if parameter.is_flag else f"{long} {word}"
            if long == "--help" or parameter.hidden:
                continue
            word = word if parameter.required else f"[{word}]"
        yield word


def test_the_commands_are_those_that_are_promised() -> None:
    found = {
        name: cli.get_command(click.Context(cli, **cli.context_settings), name)
        for name in cli.list_commands(click.Context(cli, **cli.context_settings))
    }
    groups = {name: list(group.commands) for name, group in found.items() if isinstance(group, click.Group)}
    assert {*found, *(f"{name} {one}" for name, names in groups.items() for one in names)} == set(PROMISED)
    assert set(kinds()) >= SPOKEN


@pytest.mark.parametrize("name", PROMISED)
def test_a_command_takes_what_is_promised_and_nothing_else(name: str) -> None:
    assert set(found(name)) == promised(name)


SHAPES = {
    "hcp2 5": {
        "write 1=123.456 10=12.5,-0.0001,1234": "1 ok, 10 ok, 11 ok, 12 ok",
        "read 1 10 11 12": "1 123.456, 10 12.5, 11 -0.0001, 12 1234",
    },
    "hcp 15": {"write 98=.5,-1 --verify": "98 ok, 99 ok", "read 98 99": "98 0.5, 99 -1"},
    "microflex 7": {"read status_word hall_state": "status_word 64 HARDWARE_ENABLE, hall_state 1"},
    "msc 3": {
        "write 2008=7 flag:0=1 flag:5=1 flag:31=1": "2008 ok, flag:0 ok, flag:5 ok, flag:31 ok",
        "read 2008:2 flags --address-step 4": "2008 7, 2012 0, flags 0,5,31",
        "read flag:5 status": "flag:5 1, status 65 PROGRAM_RUNNING|AUTO_START_ENABLED",
    },
    "mentor 12": {
        "write 1.17=-47.6 --decimals 1": "1.17 ok",
        "read 01.17 1.17:2 15.60:wide": "01.17 -476, 1.17 -476, 1.18 0, 15.60:wide 0",
        "read 1.17:2 1.17:hires --chain": "1.17 -476, 1.18 0, 1.17:hires -4760",
    },
    "dc104 0": {"write 1=65535": "1 ok", "read 1 255": "1 65535, 255 0"},
    "modbus 1": {
        "write holding:100:float32=1.5 coil:5=1": "holding:100:float32 ok, coil:5 ok",
        "read holding:100:float32 holding:100:2": "holding:100:float32 1.5, holding:100 16320, holding:101 0",
        "read input:100 coil:5 discrete:5": "input:100 0, coil:5 1, discrete:5 0",
    },
    "ct-ansi 11": {"read 1.17 1.17:2": "1.17 0, 1.17 0, 1.18 0"},
}
"""Of each protocol a node, commands to it without their PORT, and the lines that they print, one after another."""


@pytest.mark.slow
@pytest.mark.parametrize("drive", SHAPES)
def test_each_item_prints_the_lines_that_are_promised(busmaster: Command, drive: str) -> None:
    protocol, node = drive.split()
    with serve(protocol, int(node)) as server:
        port = (server.path, "--protocol", protocol, "--timeout", "1000", *(("--node", node) * (protocol != "dc104")))
        for text, lines in SHAPES[drive].items():
            verb, *rest = text.split()
            done = busmaster(verb, *port, *rest)
            assert (done.status, done.lines, done.err) == (0, lines.split(", "), "")


@pytest.mark.slow
def test_json_is_an_object_a_line_with_the_promised_fields(busmaster: Command, controllers: TcpServer) -> None:
    hcp2 = (controllers.path, "--protocol", "hcp2", "--timeout", "1000")
    for arguments, fields in (
        (("read", *hcp2, "--node", "5", "100"), ["node", "item", "value", "time"]),
        (("write", *hcp2, "--node", "5", "1=2"), ["node", "item", "ok", "time"]),
        (("scan", *hcp2, "--nodes", "5"), ["node", "value", "answer", "time"]),
    ):
        done = busmaster(*arguments, "--json")
        assert (done.status, done.err) == (0, "")
        assert list(json.loads(done.out)) == fields


@pytest.mark.slow
def test_each_exit_status_is_the_promised_one(busmaster: Command, controllers: TcpServer) -> None:
    """That of Ctrl-C, 130, takes a process: see test_processes."""
    hcp2 = (controllers.path, "--protocol", "hcp2", "--timeout", "1000", "--node", "5")
    for status, arguments in (
        (0, ("read", *hcp2, "1")),
        (1, ("read", *hcp2, "1", "--node", "99", "--retries", "0", "--timeout", "20")),
        (1, ("write", *hcp2, "100=1")),
        (2, ("read", *hcp2, "axis9.position")),
        (2, ("write", *hcp2, "axis0.position=1")),
        (2, ("read", *hcp2)),
    ):
        done = busmaster(*arguments)
        assert done.status == status
        assert bool(done.out) == (status == 0)
        assert done.err.count("\n") == (status > 0)
        assert status == 0 or done.err.startswith("busmaster: ")


@pytest.mark.parametrize("command", ["discover", "doctor", "scan"])
def test_a_port_that_is_none_is_wrong_usage(command: str, busmaster: Command) -> None:
    outcome = busmaster(command, "/dev/ttyUSB0?baudrate=fast", "--yes" if command == "discover" else "--json")
    assert (outcome.status, outcome.out) == (2, "")
