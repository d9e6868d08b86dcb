"""The [emulator] of a file: how its line and each of its nodes are emulated. `config.emulated` makes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from busmaster.app.config.keys import Form, Internal, keys_of, names_of, read_keys, read_section, table_of, tables_of
from busmaster.app.config.names import expanded
from busmaster.app.config.options import DELAY, check_keys, read_options
from busmaster.app.config.table import Table
from busmaster.emulator import NAMES, Delay, Faults
from busmaster.ext import NodeKind, meant

VALUES = Form("table", {"type": "object", "additionalProperties": {"$ref": "#/$defs/values"}})


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedEmulated:
    """The keys of `[emulator]` and of its nodes."""

    lively: bool = True
    """Whether values change by themselves, except those in `values`."""
    reply_delay: Annotated[Delay, DELAY] = Delay()  # noqa: RUF009  # it is frozen
    """From the end of a request to the reply: one time, or the bounds of one, `[0.001, 0.004]`."""
    faults: Annotated[Faults, table_of("faults")] = field(default_factory=Faults)
    """Faults and their probabilities: `faults = { lost = 0.01 }`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedSection(SharedEmulated):
    """The settings of one node's emulated device.

    `options` are arguments of the device. `values` are its initial values by item: one value, or several from that item
    on. `table` is the table of the settings, if there is one, and likewise for each value.
    """

    values: Annotated[Mapping[str, tuple[Table, tuple[float, ...]]], VALUES] = field(default_factory=dict)
    """Initial values by point, item or symbol: one value or several."""
    options: Internal[Mapping[str, Any]] = field(default_factory=dict)
    table: Internal[Table | None] = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatorSection(SharedEmulated):
    """How the line is emulated, and each of its nodes by name."""

    paced: bool = True
    """Whether bytes take as long as at the baud rate."""
    seed: int = 1
    """The seed of the random numbers."""
    nodes: Annotated[Mapping[str, EmulatedSection], tables_of("emulated_node")]
    """A table for each node, or range of nodes, that differs: `[emulator.nodes.NAME]`."""


def read_emulator(table: Table, nodes: Mapping[str, NodeKind]) -> EmulatorSection:
    """Read [emulator], and its tables of nodes, which go before it: a later one before an earlier one.

    Raises FileError, naming line and key.
    """
    values = read_section(table, EmulatorSection)
    shared = table.table("faults")
    every = {key.name: values[key.name] for key in keys_of(SharedEmulated) if key.name in values}
    # of its own each: faults are set anew while a line is emulated
    sections = {name: EmulatedSection(**every, faults=_faults(shared, {})) for name in nodes}
    for one in table.tables("nodes"):
        with one.part():
            with one.at():
                names = list(expanded(one.name, nodes))
            for name in names:
                if name not in nodes:
                    raise one.error(f"no such node {name!r}; {meant(name, nodes)}")
                sections[name] = _changed(sections[name], one, nodes[name], shared)
    return EmulatorSection(**values, faults=_faults(shared, {}), nodes=sections)


def _changed(section: EmulatedSection, table: Table, kind: NodeKind, shared: Table) -> EmulatedSection:
    """Return the section, changed by a node's table."""
    check_keys(table, kind, names_of(keys_of(EmulatedSection)), lambda other: other.emulated)
    held = table.table("values")
    return replace(
        section,
        **read_keys(table, keys_of(EmulatedSection)),
        faults=_faults(table.table("faults"), shared.data),
        values={**section.values, **{item: (held, held.numbers(item)) for item in held.data}},
        options={**section.options, **read_options(table, kind.emulated)},
        table=table,
    )


def _faults(table: Table, base: Mapping[str, Any]) -> Faults:
    """Return the faults of the table over `base`."""
    faults = Faults()
    table.only(*NAMES)
    for name, rate in {**base, **read_keys(table, keys_of(Faults))}.items():
        with table.at(name):
            setattr(faults, name, rate)
    return faults
