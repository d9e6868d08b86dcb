"""NODE@PORT and NODE@LINE.toml: nodes as commands name them, also of a line that another program owns."""

from __future__ import annotations

from dataclasses import dataclass, field

import click

from busmaster import Bus, ext
from busmaster.app.cli.arguments import Connection
from busmaster.app.cli.capturing import capturing
from busmaster.app.cli.lines import is_line_file, load
from busmaster.app.cli.reaching import owner_to_use, reach
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.ext import Handle, NodeKind, find, is_decimal, meant

AT = "@"
NODE_AT = "NODE@PORT|NODE@LINE.toml"


@dataclass(frozen=True, slots=True)
class Target:
    """A node that is named on the command line, with a handle without decimals of its own.

    `line` is that of its LINE.toml, None for a node of a PORT; `name` is what the file calls it. `owned`: the bus is
    that of the program that owns the line.
    """

    kind: NodeKind
    bus: Bus | RemoteBus
    handle: Handle
    line: ConfiguredLine | None = None
    name: str = ""
    owned: bool = False

    @property
    def label(self) -> str:
        return self.handle.node.label


@dataclass
class Lines:
    """The lines of the nodes of one command: a line is opened once, though two of its nodes are compared."""

    buses: dict[str, Bus | RemoteBus] = field(default_factory=dict)
    files: dict[str, ConfiguredLine] = field(default_factory=dict)

    def target(self, connection: Connection, node: str) -> Target:
        """Return a node. Raises UsageError or InvalidCommand for one that does not exist."""
        port = connection.port
        if is_line_file(port):
            return self._of_file(connection, node)
        if node and not is_decimal(node):
            raise click.UsageError(f"{node!r} is not an address; on a PORT, name the node by its address")
        address = connection.one_address(int(node) if node else None)
        bus = self.buses.get(port) or self.buses.setdefault(port, reach(connection))
        return Target(find(connection.protocol), bus, ext.plain_handle(connection.open_handle(bus, address)))

    def _of_file(self, connection: Connection, node: str) -> Target:
        port = connection.port
        if port not in self.files:
            file = load(port)
            owner = owner_to_use(file.port, connection.capture)
            recording = capturing(connection.capture, port=file.port.name, echo=file.port.echo)
            recorder = click.get_current_context().with_resource(recording)
            self.files[port] = ConfiguredLine(file, outputs=False, tap=recorder)
            self.buses[port] = self.files[port].bus if owner is None else connect(owner.address)
        line, bus = self.files[port], self.buses[port]
        if node not in line.nodes:
            raise click.UsageError(f"{port} has no node {node!r}; {meant(node, line.nodes)}")
        owned = bus is not line.bus
        handle = ext.plain_handle(line.handle(node, bus if owned else None))
        return Target(line.file.nodes[node].kind, bus, handle, line, node, owned)


def split(text: str) -> tuple[str, str]:
    """Return the node and the port or file of NODE@PORT. Raises UsageError."""
    node, at, where = text.partition(AT)
    if not at or not where:
        raise click.UsageError(f"{text!r} is not a node; write it as {NODE_AT}, like winder@line.toml")
    return node, where
