"""The command line, as its reference and its manual page have it: made of the commands themselves."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass

import click

from busmaster.app.cli.app import STATUSES, cli
from busmaster.registry import kinds

ENVIRONMENT = {
    "BUSMASTER_TOKEN": "The token for a line or an interface at tcp://HOST:PORT.",
    "BUSMASTER_DEBUG": "1: print the log, and the traceback of an internal error, on standard error.",
    "NO_COLOR": "If it is set, nothing is coloured.",
    "XDG_RUNTIME_DIR": "The lines of a user are served in its folder busmaster.",
    "RUNTIME_DIRECTORY": "Set by systemd: the folder in which a line that is a system service is served.",
}
FILES = {
    "LINE.toml": "A line: its port, nodes, points, groups and outputs.",
    "$XDG_RUNTIME_DIR/busmaster": "The sockets of this user's lines.",
    "/run/busmaster": "Those of lines that are services of the system.",
}
LINE, TCP = "/dev/ttyUSB0", "socket://127.0.0.1:5020"
RUN, CTRL_C = "", "Ctrl-C"
LONG, TERMINAL, DRIVES = "not run: takes long", "not run: needs a terminal", "not run: needs hardware"
EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "demo": (("demo --plain", CTRL_C),),
    "read": ((f"read {LINE} --protocol hcp2 --node 5 1 axis0.position", RUN),),
    "write": (
        (f"write {LINE} --protocol hcp2 --node 5 --verify 1=123.456", RUN),
        ("write line.toml winder/setpoint=120", RUN),
        (f"write {LINE} --protocol msc --node 3 --address-step 4 3000:500=@cam.csv --verify", DRIVES),
    ),
    "do": (
        (f"do 7@{LINE} enable --protocol microflex", DRIVES),
        ("do winder@line.toml execute 1 200 25 --within 10", DRIVES),
    ),
    "poll": ((f"poll {LINE} --protocol hcp2 --nodes 1-4 --items 1,2 --period 0.2", CTRL_C),),
    "trend": (
        (f"trend {LINE} --protocol hcp2 5/axis0.position 5/axis0.velocity --seconds 4", RUN),
        ("trend line.toml winder/axis0.position --period 0.1 --csv trend.csv", TERMINAL),
    ),
    "scan": ((f"scan {LINE} --protocol hcp2 --nodes 1-8", RUN),),
    "discover": ((f"discover {LINE} --yes -o found.toml", LONG),),
    "emulate": (
        ("emulate --protocol hcp2 --nodes 1-8 --pty line", CTRL_C),
        ("emulate line.toml --tcp 127.0.0.1:0", CTRL_C),
    ),
    "run": (("run line.toml", CTRL_C),),
    "serve": (("serve line.toml", CTRL_C),),
    "status": (("status", RUN),),
    "top": (("top", TERMINAL),),
    "web": (("web --bind 127.0.0.1:8420", CTRL_C),),
    "opcua": (("opcua --allow 'drive*/speed_reference'", CTRL_C),),
    "safe": (("safe line.toml", DRIVES),),
    "check": (("check line.toml", RUN),),
    "migrate": (("migrate line.toml", RUN),),
    "plan": (("plan line.toml", RUN),),
    "points": (("points line.toml --csv >points.csv", RUN), ("points line.toml --from points.csv", RUN)),
    "monitor": ((f"monitor {LINE} --protocol hcp2", DRIVES),),
    "doctor": ((f"doctor {LINE} --protocol hcp2 --nodes 1-8", LONG),),
    "bench": (
        ("bench --protocol hcp2 --nodes 1-32 --virtual --every 0.5 --period 0.5 --budget cycle.p99=400", RUN),
        (f"bench {LINE} --protocol hcp2 --nodes 1-8 --seconds 60 --json >today.json", LONG),
        ("bench --compare yesterday.json today.json --budget p99=1.2x", LONG),
    ),
    "replay": (
        (f"read {LINE} --protocol hcp2 --node 5 1 --capture line.pcapng", RUN),
        ("replay line.pcapng", RUN),
    ),
    "items": (("items hcp2 axis0 error", RUN),),
    "params": (),
    "params diff": (
        (f"params diff winder.toml 5@{LINE} --protocol hcp2", DRIVES),
        ("params diff winder.toml press.toml", DRIVES),
    ),
    "params load": (
        ("params load winder.toml press@line.toml --dry-run", DRIVES),
        ("params load winder.toml press@line.toml", TERMINAL),
    ),
    "params save": (
        (f"params save {LINE} --protocol hcp2 5 -o winder.toml", LONG),
        ("params save line.toml winder -o winder.toml", DRIVES),
    ),
}
"""Of each command, and how a test takes it: run to its end, or until Ctrl-C, or not at all. Those of an interface that
is found by an entry point are in the `epilog` of its command: "Example: busmaster NAME ..."."""


@dataclass(frozen=True, slots=True)
class Described:
    """One command: its usage, the paragraphs of its help, and its options, each with what it does."""

    name: str
    usage: str
    paragraphs: tuple[str, ...]
    options: tuple[tuple[str, str], ...]
    examples: tuple[tuple[str, str], ...]


def described(command: click.Command, name: str = "") -> Described:
    """What a command says of itself."""
    top = click.Context(cli, info_name="busmaster", **cli.context_settings)
    context = click.Context(command, top, info_name=name) if name else top
    usage = " ".join(command.collect_usage_pieces(context))
    text = inspect.cleandoc(command.help or "")
    parameters = [one for one in command.get_params(context) if isinstance(one, click.Option) and not one.hidden]
    options = [option for option in parameters if "--help" not in option.opts]
    return Described(
        name,
        f"busmaster {name} {usage}".replace("  ", " "),
        tuple(" ".join(paragraph.split()) for paragraph in text.split("\n\n")),
        tuple((_named(option), _said(option, context)) for option in options),
        EXAMPLES.get(name) or _own_examples(command),
    )


def _own_examples(command: click.Command) -> tuple[tuple[str, str], ...]:
    """The example of an interface, which goes on until Ctrl-C."""
    _, _, example = (command.epilog or "").partition("Example: busmaster ")
    return ((example, CTRL_C),) if example else ()


def _named(option: click.Option) -> str:
    return " ".join([", ".join(option.opts), *([] if option.is_flag else [option.metavar or "VALUE"])])


def _said(option: click.Option, context: click.Context) -> str:
    record = option.get_help_record(context)
    said = [re.sub(r"  \[[^][]*\]$", "", record[1] if record else "")]
    if isinstance(option.type, click.IntRange) and option.type.min:
        said.append(f"{option.type.min} or more.")
    if option.required:
        said.append("Required.")
    if option.show_default and option.default is not None:
        said.append(f"{option.default} by default.")
    return " ".join(" ".join(said).split())


def commands(group: click.Group = cli, before: str = "") -> Iterator[Described]:
    """Every command, in the order of the help; those of a group behind it, as `params save`."""
    context = click.Context(group, **group.context_settings)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield described(command, f"{before}{name}")
        if isinstance(command, click.Group):
            yield from commands(command, f"{before}{name} ")


def page() -> str:
    """The reference of the command line, in Markdown."""
    return "\n".join(_page())


def _page() -> Iterator[str]:
    yield "# The command line\n"
    yield "`busmaster COMMAND --help` and the manual page busmaster(1) contain the same text.\n"
    yield from (f"{paragraph}\n" for paragraph in described(cli).paragraphs)
    yield "## Exit status\n\n| status | meaning |\n|---|---|"
    yield from (f"| {status} | {about} |" for status, about in STATUSES.items())
    yield "\nStandard output contains only results. Each error is one line on standard error.\n"
    yield "With `--json`, the results are objects with the fields of [JSON output](json-output.md).\n"
    yield "## Environment\n\n| variable | meaning |\n|---|---|"
    yield from (f"| `{name}` | {about} |" for name, about in ENVIRONMENT.items())
    yield "\n## ITEM\n\nThe forms of ITEM. `busmaster items PROTOCOL` lists the items and their meaning.\n"
    yield "| protocol | ITEM |\n|---|---|"
    yield from (f"| {kind.name} | {kind.items} |" for kind in kinds().values())
    yield """
## Manual page and completion

The package brings busmaster(1), and completion of commands and options by Tab for bash, zsh and fish, to where the
system looks for them. In a virtual environment the manual page is found while that is active, and bash completes after
`source .venv/share/bash-completion/completions/busmaster`."""
    yield f"\n<!-- line {LINE}: --protocol hcp2 --nodes 1-8 -->\n<!-- file: line.toml from examples/line.toml -->"
    yield f"<!-- line {TCP}: line.toml -->\n"
    for command in commands():
        yield f"## busmaster {command.name}\n\n```text\n{command.usage}\n```\n"
        yield from (f"{paragraph}\n" for paragraph in command.paragraphs)
        if command.options:
            yield "| option | meaning |\n|---|---|"
            yield from (f"| `{names}` | {_cell(about)} |" for names, about in command.options)
            yield ""
        for text, mark in command.examples:
            yield _block(text, mark)


def _block(text: str, mark: str) -> str:
    if mark == CTRL_C:
        return f"```console\n$ busmaster {text}\n...\n^C\n```\n"
    return (f"<!-- {mark} -->\n" if mark else "") + f"```sh\nbusmaster {text}\n```\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def manual(version: str) -> str:
    """The manual page, in roff."""
    return "\n".join(_manual(version)) + "\n"


def _manual(version: str) -> Iterator[str]:
    whole = described(cli)
    yield ".\\\" Made of the program's own help by tests/docs/reference.py: change that."
    yield f'.TH BUSMASTER 1 "" "busmaster {version}" "User Commands"'
    yield f".SH NAME\nbusmaster \\- {_roff(whole.paragraphs[0][:1].lower() + whole.paragraphs[0][1:].rstrip('.'))}"
    yield ".SH SYNOPSIS"
    for command in commands():
        yield f".B busmaster {command.name}\n{_roff(command.usage.removeprefix(f'busmaster {command.name} '))}\n.br"
    yield ".SH DESCRIPTION"
    yield from _paragraphs(whole.paragraphs[1:])
    yield ".SH COMMANDS"
    for command in commands():
        yield f".SS {command.name}"
        yield from _paragraphs(command.paragraphs)
        yield from _terms((_roff(names), _roff(about)) for names, about in command.options)
    yield ".SH ITEM\nWhat ITEM is, by protocol:"
    yield from _terms((kind.name, _roff(kind.items)) for kind in kinds().values())
    for title, entries in (("EXIT STATUS", STATUSES), ("ENVIRONMENT", ENVIRONMENT), ("FILES", FILES)):
        yield f".SH {title}"
        yield from _terms((_roff(name), _roff(about)) for name, about in entries.items())
    yield ".SH EXAMPLES\n.nf"
    for command in commands():
        yield from (_roff(f"busmaster {text}") for text, _ in command.examples)
    yield ".fi"


def _paragraphs(texts: tuple[str, ...]) -> Iterator[str]:
    for text in texts:
        yield f".PP\n{_roff(text)}"


def _terms(entries: Iterator[tuple[str, str]]) -> Iterator[str]:
    for name, about in entries:
        yield f".TP\n.B {name}\n{about}"


def _roff(text: str) -> str:
    """A text on one line, as roff has it."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("`", "")
    return re.sub(r"^(?=[.'])", r"\\&", escaped)
