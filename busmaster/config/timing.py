"""Reply times as a file gives them, in seconds.

timing = { window = 0.2, lateness = 0.3 }          # of reads and writes
timing = { write = { window = 0.8 } }              # of writes alone; so too read and packet (msc)
"""

from __future__ import annotations

from dataclasses import replace

from busmaster.config.table import Table
from busmaster.contract.timing import ReplyTiming, Timings

LONGEST = 10.0
"""Seconds: whoever writes more means milliseconds."""
TIMES = ("nominal", "window", "lateness", "byte_gap", "turnaround")


def read_timings(table: Table, base: Timings) -> Timings:
    """`base` with what the table's `timing` changes. Nominal and lateness move with the window where they must."""
    timing = table.table("timing")
    timing.only(*TIMES, "read", "write", "packet")
    read, write = _changed(timing, base.read), _changed(timing, base.write)
    return Timings(
        read=_changed(timing.table("read"), read, leg=True),
        write=_changed(timing.table("write"), write, leg=True),
        packet=_changed(timing.table("packet"), base.packet, leg=True),
    )


def _changed(table: Table, timing: ReplyTiming, leg: bool = False) -> ReplyTiming:
    if leg:
        table.only(*TIMES)
    given = {name: table.seconds(name) for name in TIMES if name in table}
    for name, time in given.items():
        if time > LONGEST:
            raise table.error(f"times are in seconds, {LONGEST:g} at most: for {time:g} ms write {time / 1000:g}", name)
    window = given.get("window", timing.window)
    moved = {"nominal": min(timing.nominal, window), "lateness": max(timing.lateness, window)}
    with table.at():
        return replace(timing, **{**moved, **given})
