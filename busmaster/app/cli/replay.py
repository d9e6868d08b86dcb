"""`busmaster replay`: a capture, run through the readers of today."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any, BinaryIO

import click

from busmaster.app.cli.arguments import json_option
from busmaster.app.cli.output import emit, json_line, note
from busmaster.app.service.values import utc
from busmaster.capture import CaptureError, CutOff, Packet, Replayed, read_packets, replay_packets

CHANGED = 1
COUNTED = ("same", "changed", "unjudged")


@click.command(short_help="Read a capture again, by the readers of today.")
@click.argument("capture", type=click.Path(exists=True, dir_okay=False))
@json_option
def command(capture: str, as_json: bool) -> int:
    """Read again what a capture has recorded, and say what comes out otherwise than it was recorded.

    A line for each exchange that has changed, then how many there were. The exit status is 1 if any has. What no
    reader was asked about is not judged: bytes that the port called damaged, say, or an exchange that was cut off.
    A file that is cut off, as its recorder was killed, is read up to there, and that is said on standard error.
    With --json every exchange is an object, changed or not, and so are the counts behind them.
    """
    counts: Counter[str] = Counter()
    try:
        with open(capture, "rb") as file:
            for one in replay_packets(whole_packets(file)):
                counts["changed" if one.changed else "same" if one.judged else "unjudged"] += 1
                if as_json:
                    emit(json_line(**fields(one)))
                elif one.changed:
                    emit(changed_text(one))
    except CaptureError as error:
        raise click.UsageError(f"{capture}: {error}") from None
    emit(
        json_line(exchanges=counts.total(), **{name: counts[name] for name in COUNTED})
        if as_json
        else summary_text(counts)
    )
    return CHANGED if counts["changed"] else 0


def whole_packets(file: BinaryIO) -> Iterator[Packet]:
    """Yield the packets up to where the file is cut off, if it is. Raises CaptureError for one that is no capture."""
    packets = 0
    try:
        for packet in read_packets(file):
            packets += 1
            yield packet
    except CutOff as error:
        note(f"{file.name}: {error}, behind packet {packets}: what is before is replayed")


def fields(one: Replayed) -> dict[str, Any]:
    """Return an exchange as a JSON object: what was recorded, and what comes out now."""
    return {
        "packet": one.packet,
        "time": utc(one.micros / 1e6, "microseconds"),
        "node": one.node,
        "command": one.command,
        "recorded": str(one.recorded),
        "now": str(one.now),
        "judged": one.judged,
        "changed": one.changed,
    }


def changed_text(one: Replayed) -> str:
    """Return the line of an exchange that has changed: what was recorded, and what comes out now."""
    moment = utc(one.micros / 1e6, "microseconds")
    node = "" if one.node is None else f"node {one.node}: "
    return f"packet {one.packet}, {moment}, {node}{one.command}: was {one.recorded}, is {one.now}"


def summary_text(counts: Counter[str]) -> str:
    """Return the line that says how many exchanges there were, and how many have changed."""
    total = counts.total()
    text = f"{total} exchange{'' if total == 1 else 's'}: {counts['same']} the same, {counts['changed']} changed"
    return text + (f", {counts['unjudged']} not judged" if counts["unjudged"] else "")
