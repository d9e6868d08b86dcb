"""Reply times as a file gives them, in seconds.

timing = { window = 0.2, max_reply_delay = 0.3 }          # of reads and writes
timing = { write = { window = 0.8 } }              # of writes alone; so too read and packet (msc)
timing = "learned"                                 # from the replies; { learned = true, ... } with other times, too
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeAlias

from busmaster import ReplyTiming, Timings
from busmaster.app.bounds import LONGEST_TIMING
from busmaster.app.config.keys import Form, keys_of, names_of, number, read_keys, read_section, table_of
from busmaster.app.config.table import Table
from busmaster.ext import Between

LEARNED_WORD = "learned"
TIMING = Form("table or text", {"anyOf": [{"enum": [LEARNED_WORD]}, {"$ref": "#/$defs/timing"}]}, name="timing")
"""Of a node's reply times."""


def _read_time(table: Table, key: str) -> float:
    time = table.seconds(key, most=math.inf)
    if time > LONGEST_TIMING:
        raise table.error(f"must be at most {LONGEST_TIMING:g}, in seconds; for {time:g} ms write {time / 1000:g}", key)
    return time


Time: TypeAlias = Annotated[float | None, replace(number(Between(0, LONGEST_TIMING, "s")), read=_read_time)]
Times: TypeAlias = Annotated[Mapping[str, Any] | None, table_of("times")]


@dataclass(frozen=True, slots=True, kw_only=True)
class TimesSection:
    """The reply times of requests of one kind; those that are left out are the protocol's."""

    late_after: Time = None
    """A reply that begins by then is on time; a later one is counted late. The protocol's by default."""
    window: Time = None
    """A reply that begins by then is as expected; a later one, until `max_reply_delay`, is delivered late. The
    protocol's by default."""
    max_reply_delay: Time = None
    """Longest time after a request at which its reply can begin. It must exceed the slowest reply, or replies can be
    attributed to the wrong request (R3). The protocol's by default."""
    inter_byte_timeout: Time = None
    """The longest pause between two bytes of one reply. The protocol's by default."""
    driver_release_time: Time = None
    """How long the node's driver holds the line after its reply. The protocol's by default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimingSection(TimesSection):
    """The reply times of a node."""

    read: Times = None
    """The same times, of reads alone."""
    write: Times = None
    """The same times, of writes alone."""
    packet: Times = None
    """The same times, of a packet that follows an acknowledgement, where there are such."""
    learned: bool = False
    """Whether windows are learned from the replies; `timing = "learned"` is short for it. The others are then those to
    begin with."""


def read_timings(table: Table, base: Timings) -> Timings:
    """Return `base`, changed by the table's `timing`.

    `late_after` and the maximum reply delay change with the window if necessary.
    """
    if isinstance(table.data.get("timing"), str):
        table.choice("timing", (LEARNED_WORD,))
        return base
    timing = table.table("timing")
    timing.only(*names_of(keys_of(TimingSection)))
    both = read_keys(timing, keys_of(TimesSection))
    read, write = _changed(timing, base.read, both), _changed(timing, base.write, both)
    return Timings(
        read=_step(timing, read, "read"),
        write=_step(timing, write, "write"),
        packet=_step(timing, base.packet, "packet"),
    )


def reads_learned(table: Table, base: bool) -> bool:
    """Return whether the table's `timing` requests learned reply times; `base` if it does not contain that."""
    timing = table.data.get("timing")
    if isinstance(timing, str):
        return timing == LEARNED_WORD
    table = table.table("timing")
    return table.flag("learned") if "learned" in table else base


def _step(timing: Table, base: ReplyTiming, name: str) -> ReplyTiming:
    table = timing.table(name)
    return _changed(table, base, read_section(table, TimesSection))


def _changed(table: Table, timing: ReplyTiming, given: Mapping[str, float]) -> ReplyTiming:
    window = given.get("window", timing.window)
    moved = {"late_after": min(timing.late_after, window), "max_reply_delay": max(timing.max_reply_delay, window)}
    with table.at():
        return replace(timing, **{**moved, **given})
