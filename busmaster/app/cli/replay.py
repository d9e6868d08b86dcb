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


@click.command()
@click.argument("capture", type=click.Path(exists=True, dir_okay=False))
@json_option
def command(capture: str, as_json: bool) -> int:
    """Decode a capture with this version, and show differences from the recorded results.

    The command prints a line for each exchange that has changed, then the counts. The exit status is 1 if any has
    changed. Exchanges without a recorded result are not judged, for example damaged bytes or an incomplete exchange.
    If the file is incomplete, because its recorder was killed, it is read up to that place, and a message is printed.
    With --json, each exchange is an object, changed or not, and the counts are the last object.
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
    """Yield the packets, up to the end of an incomplete file. Raises CaptureError for a file that is not a capture."""
    packets = 0
    try:
        for packet in read_packets(file):
            packets += 1
            yield packet
    except CutOff as error:
        note(f"{file.name}: {error}, after packet {packets}; only the packets before are replayed")


def fields(one: Replayed) -> dict[str, Any]:
    """Return an exchange as a JSON object, with the recorded and the present result."""
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
    """Return the line of an exchange that has changed, with the recorded and the present result."""
    moment = utc(one.micros / 1e6, "microseconds")
    node = "" if one.node is None else f"node {one.node}: "
    return f"packet {one.packet}, {moment}, {node}{one.command}: was {one.recorded}, is {one.now}"


def summary_text(counts: Counter[str]) -> str:
    """Return the line with the numbers of all and of changed exchanges."""
    total = counts.total()
    text = f"{total} exchange{'' if total == 1 else 's'}: {counts['same']} the same, {counts['changed']} changed"
    return text + (f", {counts['unjudged']} not judged" if counts["unjudged"] else "")
