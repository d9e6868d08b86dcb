"""The [emulator] of a file: how its line and each of its nodes are emulated. `config.emulated` makes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from busmaster.app.config.keys import Key, names_of
from busmaster.app.config.names import expanded
from busmaster.app.config.options import check_keys, read_delay, read_options
from busmaster.app.config.table import Table
from busmaster.emulator import NAMES, Delay, Faults
from busmaster.ext import meant
from busmaster.registry import NodeKind

SHARED = (
    Key("lively", "flag", "Whether things move by themselves, but for what `values` give.", "true"),
    Key(
        "reply_delay",
        "delay",
        "From the end of a request to the reply: one time, or the bounds of one, `[0.001, 0.004]`.",
        f"{Delay().low:g}",
        "s",
    ),
    Key("faults", "table", "What goes wrong, and how often: `faults = { lost = 0.01 }`."),
)
KEYS = (
    Key("paced", "flag", "Whether bytes take their time on the wire.", "true"),
    Key("seed", "whole", "The seed of all that is random.", "1", least=0),
    *SHARED,
    Key("nodes", "table", "A table for each node, or range of nodes, that differs: `[emulator.nodes.NAME]`."),
)
"""Of `[emulator]`."""
NODE_KEYS = (
    *SHARED,
    Key("values", "table", "What it holds from the start, by point, item or symbol: one value or several."),
)
"""What can be said of every emulated device; its kind's options come to it."""


@dataclass(frozen=True, slots=True)
class EmulatedSection:
    """What the file says of one node's emulated device.

    `options` are arguments of what makes it. `values` are what it holds from the start, by item: one value, or those
    from that item on. `table` is where it is said, if it is; so is the table that each value stands in.
    """

    delay: Delay
    faults: Faults
    lively: bool
    options: Mapping[str, Any] = field(default_factory=dict)
    values: Mapping[str, tuple[Table, tuple[float, ...]]] = field(default_factory=dict)
    table: Table | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class EmulatorSection:
    """How the line is emulated, and each of its nodes by name. `paced`: bytes take their time on the wire."""

    paced: bool
    seed: int
    nodes: Mapping[str, EmulatedSection]


def read_emulator(table: Table, nodes: Mapping[str, NodeKind]) -> EmulatorSection:
    """Read [emulator], and its tables of nodes, which go before it: a later one before an earlier one.

    Raises FileError, naming line and key.
    """
    table.only(*names_of(KEYS))
    shared = table.table("faults")
    every = EmulatedSection(_delay(table, Delay()), _faults(shared, {}), table.flag("lively", True))
    # of its own each: faults are set anew while a line is emulated
    sections = {name: replace(every, faults=_faults(shared, {})) for name in nodes}
    for one in table.tables("nodes"):
        with one.part():
            with one.at():
                names = list(expanded(one.name, nodes))
            for name in names:
                if name not in nodes:
                    raise one.error(f"no such node {name!r}; {meant(name, nodes)}")
                sections[name] = _changed(sections[name], one, nodes[name], shared)
    return EmulatorSection(paced=table.flag("paced", True), seed=table.whole("seed", 1), nodes=sections)


def _changed(section: EmulatedSection, table: Table, kind: NodeKind, shared: Table) -> EmulatedSection:
    """Return the section with what a node's table says."""
    check_keys(table, kind, names_of(NODE_KEYS), lambda other: other.emulated)
    values = table.table("values")
    return EmulatedSection(
        delay=_delay(table, section.delay),
        faults=_faults(table.table("faults"), shared.data),
        lively=table.flag("lively", section.lively),
        options={**section.options, **read_options(table, kind.emulated)},
        values={**section.values, **{item: (values, values.numbers(item)) for item in values.data}},
        table=table,
    )


def _delay(table: Table, default: Delay) -> Delay:
    return read_delay(table, "reply_delay") if "reply_delay" in table else default


def _faults(table: Table, base: Mapping[str, Any]) -> Faults:
    """Return the faults of the table over `base`."""
    table.only(*NAMES)
    faults = Faults()
    for name, rate in {**base, **{name: table.number(name) for name in table.data if name in NAMES}}.items():
        with table.at(name):
            setattr(faults, name, rate)
    return faults
