"""Reply times as a file gives them, in seconds.

timing = { window = 0.2, max_reply_delay = 0.3 }          # of reads and writes
timing = { write = { window = 0.8 } }              # of writes alone; so too read and packet (msc)
timing = "learned"                                 # from the replies; { learned = true, ... } with other times, too
"""

from __future__ import annotations

import math
from dataclasses import replace

from busmaster import ReplyTiming, Timings
from busmaster.app.config.keys import Key, names_of
from busmaster.app.config.table import Table
from busmaster.bounds import LONGEST_TIMING

LEARNED_WORD = "learned"


def _time(name: str, about: str) -> Key:
    return Key(name, "seconds", f"{about} The protocol's by default.", unit="s", least=0, most=LONGEST_TIMING)


TIME_KEYS = (
    _time("late_after", "A reply that begins by then is on time; a later one is counted late."),
    _time(
        "window", "A reply that begins by then is as expected; a later one, until `max_reply_delay`, is delivered late."
    ),
    _time(
        "max_reply_delay", "What has not begun by then never comes: on this it rests that no value is another's (R3)."
    ),
    _time("inter_byte_timeout", "The longest pause between two bytes of one reply."),
    _time("driver_release_time", "How long the node's driver holds the line after its reply."),
)
KEYS = (
    *TIME_KEYS,
    Key("read", "table", "The same times, of reads alone."),
    Key("write", "table", "The same times, of writes alone."),
    Key("packet", "table", "The same times, of a packet that follows an acknowledgement, where there are such."),
    Key(
        LEARNED_WORD,
        "flag",
        'Whether windows are learned from the replies; `timing = "learned"` is short for it. The others are then those '
        "to begin with.",
        "false",
    ),
)
"""Of `timing`."""
TIMES = names_of(TIME_KEYS)


def read_timings(table: Table, base: Timings) -> Timings:
    """Return `base` with what the table's `timing` changes.

    Nominal and maximum reply delay move with the window where they must.
    """
    if isinstance(table.data.get("timing"), str):
        table.choice("timing", (LEARNED_WORD,))
        return base
    timing = table.table("timing")
    timing.only(*names_of(KEYS))
    read, write = _changed(timing, base.read), _changed(timing, base.write)
    return Timings(
        read=_changed(timing.table("read"), read, step=True),
        write=_changed(timing.table("write"), write, step=True),
        packet=_changed(timing.table("packet"), base.packet, step=True),
    )


def reads_learned(table: Table, base: bool) -> bool:
    """Return whether the table's `timing` says that reply times are to be learned; `base` where it says nothing."""
    timing = table.data.get("timing")
    if isinstance(timing, str):
        return timing == LEARNED_WORD
    return table.table("timing").flag(LEARNED_WORD, base)


def _changed(table: Table, timing: ReplyTiming, step: bool = False) -> ReplyTiming:
    if step:
        table.only(*TIMES)
    given = {name: table.seconds(name, most=math.inf) for name in TIMES if name in table}
    for name, time in given.items():
        if time > LONGEST_TIMING:
            raise table.error(
                f"times are in seconds, {LONGEST_TIMING:g} at most: for {time:g} ms write {time / 1000:g}", name
            )
    window = given.get("window", timing.window)
    moved = {"late_after": min(timing.late_after, window), "max_reply_delay": max(timing.max_reply_delay, window)}
    with table.at():
        return replace(timing, **{**moved, **given})
