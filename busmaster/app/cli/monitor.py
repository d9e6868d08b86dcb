"""`busmaster monitor`: what passes on a line, without a word of our own."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from typing import Any

import anyio
import click

from busmaster import Endpoint, LineDown, Snapshot, ext
from busmaster.app.cli.arguments import Connection
from busmaster.app.cli.capturing import capture_option, capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.lines import is_line_file, load
from busmaster.app.cli.output import Level, emit, emit_all, json_line, note, value_text
from busmaster.app.cli.overheard import Clock, Overheard, feed, only_protocol, silent
from busmaster.app.cli.parsing import Whole
from busmaster.app.cli.protocols import protocol_option
from busmaster.app.cli.run import output_text
from busmaster.app.config import LineFile
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.values import cycle_fields, utc
from busmaster.capture import DEFAULT_GAP, Decoder, Direction, Frame, Kind, Recorder
from busmaster.events import AlarmChanged, BusEvent, Stream
from busmaster.ext import cause_text, check_settings, find

BEAT = 0.05
"""Seconds between two readings of the clock. A longer gap means that the program was stopped."""
ARROWS = {Direction.HOST: "->", Direction.NODE: "<-", Direction.UNKNOWN: "??"}


@click.command()
@click.argument("port", metavar="PORT|LINE.toml")
@protocol_option(required=False)
@click.option("--baud", type=Whole(min=1), metavar="N", help="Baud rate; the protocol's by default.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
@capture_option
def command(port: str, protocol: str | None, baud: int | None, as_json: bool, capture: str | None) -> None:
    """Decode the frames on PORT, one per line, until Ctrl-C. Nothing is ever sent.

    An arrow shows the sender: the host (->) or a node (<-). The time after a reply is its delay. Frames are separated
    by their content; a silence only ends an incomplete one.

    With a LINE.toml, its points and outputs receive the values that its line's own master reads. The command prints a
    line for each value or, with --json, for each group and period. The quality of these values is "overheard", never
    good: a reply contains no address, and a listener that misses two frames can attribute it to another node.
    """
    if is_line_file(port):
        if protocol is not None or baud is not None:
            raise click.UsageError("LINE.toml already defines protocol and baud rate; leave out --protocol and --baud")
        monitor_file(load(port), as_json, capture)
        return
    if protocol is None:
        raise click.UsageError("protocol missing; use --protocol P, or a LINE.toml instead of the port")
    endpoint = Connection(port, protocol, baud).endpoint()
    kind = find(protocol)
    check_settings(kind.profile, endpoint)
    names = ext.names_of_items(kind.handle)
    write = json_text if as_json else plain_text
    with capturing(capture, port=endpoint.name, protocol=protocol) as recorder:
        decoder = Decoder(kind.protocol.dialect())
        until_ended(listen, endpoint, decoder, lambda frame: emit(write(frame, names)), recorder)


def monitor_file(file: LineFile, as_json: bool, capture: str | None) -> None:
    """Listen to the line of a file until Ctrl-C. Nothing is ever sent."""
    protocol = only_protocol(file)
    kind = find(protocol)
    line = ConfiguredLine(silent(file), report=note, asks=False)  # never entered: its bus opens no port
    points = {point for group in file.groups for point in line.members(group)}
    clock = wall_clock()
    overheard = Overheard(kind.protocol, points, clock)

    def show(snapshot: Snapshot) -> None:
        fields = {**cycle_fields(snapshot, snapshot.wall_at), "time": utc(snapshot.wall_at(snapshot.finished))}
        emit_all([json_line(**fields)] if as_json else plain_values(snapshot))

    async def report(events: Stream[BusEvent]) -> None:
        async for event in events:
            if isinstance(event, AlarmChanged):
                note(event.text, Level.WARNING if event.active else Level.NOTICE)

    async def run(recorder: Recorder | None) -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(feed, line, overheard, show)
            tasks.start_soon(report, line.bus.events())
            await listen(file.port, Decoder(kind.protocol.dialect()), overheard.heard, recorder, clock)

    with capturing(capture, port=file.port.name, protocol=protocol) as recorder:
        try:
            until_ended(run, recorder)
        finally:
            if text := ambiguous_text(overheard.ambiguous):
                note(text)
            for counts in line.outputs.statistics():
                note(output_text(counts))


def ambiguous_text(count: int) -> str:
    """Return how many replies were discarded because they could belong to another request, "" for none."""
    if count == 1:
        return "1 reply could belong to an earlier request and was discarded"
    return f"{count} replies could belong to earlier requests and were discarded" if count else ""


def plain_values(snapshot: Snapshot) -> list[str]:
    """Return a line for each value, as `2026-11-22T14:02:11.485Z winder/position 12.5`."""
    return [
        f"{utc(sample.wall)} {point.key} {value_text(sample.value, point.meaning.precision)}"
        for point, sample in snapshot.samples.items()
    ]


def wall_clock() -> Clock:
    """Return the time of day as it is set now: a clock that is set later moves no frame."""
    offset = time.time() - time.monotonic()
    return lambda: time.monotonic() + offset


class Listener(asyncio.Protocol):
    """Decode received bytes and report each frame with its time of day. An incomplete frame waits for silence.

    Bytes that were received while the program was stopped have an unknown time, after the last reading of the clock.
    """

    def __init__(
        self,
        decoder: Decoder,
        report: Callable[[Frame], None],
        recorder: Recorder | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._decoder = decoder
        self._report = report
        self._recorder = recorder
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._clock = clock or wall_clock()
        self._beats = (self._clock(),) * 2
        """When the program was last seen running, and the time before."""
        self._beating = self._loop.call_later(BEAT, self._beat)
        self._earlier = 0.0
        self.lost: asyncio.Future[None] = self._loop.create_future()

    def _beat(self) -> None:
        self._beats = (self._clock(), self._beats[0])
        self._beating = self._loop.call_later(BEAT, self._beat)

    def _unwatched(self, now: float) -> float:
        """Return how long ago bytes that are read now may have come."""
        last, before = self._beats
        # What came in the midst of a standstill may take several reads: the beat behind it does not end it.
        since = before if now - last > 2 * BEAT or last - before > 2 * BEAT else now
        return now - since

    def data_received(self, data: bytes) -> None:
        """Decode these bytes and report the frames. An incomplete frame waits for silence."""
        now = self._clock()
        if self._recorder is not None:
            self._recorder.overheard(time.monotonic(), data)
        if self._timer is not None:
            self._timer.cancel()
        self._earlier = max(self._unwatched(now), self._earlier if self._decoder.unfinished else 0.0)
        self._pass(self._decoder.feed(data, now))
        if self._decoder.unfinished:
            self._timer = self._loop.call_later(DEFAULT_GAP, self._rest)

    def connection_lost(self, cause: Exception | None) -> None:
        """Report the last frame, and end `lost` with LineDown."""
        self._beating.cancel()
        self._rest()
        if not self.lost.done():
            what = cause_text(cause, "the line was closed")
            self.lost.set_exception(LineDown(what, hint="start again when it is back"))

    def _rest(self) -> None:
        self._pass(self._decoder.quiet())

    def _pass(self, frames: list[Frame]) -> None:
        """Report each frame.

        Errors are not raised into the transport, but to the caller that waits for the end of the line.
        """
        try:
            for frame in frames:
                frame.earlier = self._earlier
                self._report(frame)
        except OSError as error:
            if not self.lost.done():
                self.lost.set_exception(error)


async def listen(
    endpoint: Endpoint,
    decoder: Decoder,
    report: Callable[[Frame], None],
    recorder: Recorder | None = None,
    clock: Clock | None = None,
) -> None:
    """Listen until the line is lost. Raises LineDown then, and the OSError of a frame that could not be printed."""
    listener = Listener(decoder, report, recorder, clock)
    transport = await endpoint.open(lambda: listener)
    try:
        await listener.lost
    finally:
        transport.close()


def plain_text(frame: Frame, names: Mapping[str, str]) -> str:
    """Return a frame as one line; the bytes too, if something is wrong.

    It reads `2026-11-22T14:02:11.485012Z <- node 5   100 (axis0.position) = 12.5  2.9 ms`.
    """
    node = "" if frame.node is None else f"node {frame.node}"
    text = frame.text
    if frame.item in names:
        text = text.replace(frame.item, f"{frame.item} ({names[frame.item]})", 1)
    parts = [f"{utc(frame.time, 'microseconds')} {ARROWS[frame.sender]} {node:8} {text}"]
    if frame.delay is not None:
        parts.append(f"{frame.delay * 1000:.1f} ms")
    if frame.fault:
        parts.append(f"! {frame.fault}: {frame.raw.hex(' ')}")
    return "  ".join(parts)


def json_text(frame: Frame, names: Mapping[str, str]) -> str:
    """Return a frame as one JSON object; null for unknown properties."""
    sender = None if frame.sender is Direction.UNKNOWN else frame.sender.name.lower()
    fields = {
        "time": utc(frame.time, "microseconds"),
        "from": sender,
        "node": frame.node,
        "kind": frame.kind.value,
        "command": frame.command or None,
        "item": frame.item or None,
        "name": names.get(frame.item),
        "value": json_values(frame) if frame.kind in (Kind.WRITE, Kind.VALUE) else None,
        "delay": None if frame.delay is None else round(frame.delay, 6),
        "fault": frame.fault or None,
        "raw": frame.raw.hex(" "),
    }
    return json.dumps(fields)


def json_values(frame: Frame) -> Any:
    """Return one number, or a list of several. A text that is not a number stays a text."""
    values = [number_of(part) for part in frame.value.split(",")] if frame.value else []
    return values if frame.item == "flags" or len(values) != 1 else values[0]


def number_of(text: str) -> int | float | str:
    """Return the number that the text is, whole if it can be, else the text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
