"""All outputs of a line: what is polled and what happens is handed to each of them, and none can hold it up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterable, Mapping
from typing import Any

import anyio

from busmaster.arbiter.events import LatenessRaised, NodeChanged
from busmaster.bus.bus import Bus
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Snapshot, Stream
from busmaster.gate.gate import Gate
from busmaster.gate.record import WriteRecord
from busmaster.outputs.base import Happening, Output, OutputStatistics
from busmaster.outputs.files import CsvOutput, JsonlOutput
from busmaster.outputs.settings import FileSettings, MetricsSettings, MqttSettings, Settings, SqliteSettings
from busmaster.outputs.sqlite import SqliteOutput
from busmaster.outputs.values import event_text, micros

WAITING = 256
"""Cycles of a group that may wait for a loop that is busy with other things."""
FAREWELL = 5.0
"""Seconds in which the outputs write what they still hold, when the line is closed."""


class Distributor:
    """The outputs of one bus. `tell` is called, on the loop, with what happens to them.

    `gate` is what the commands pass that they take in.
    """

    def __init__(self, bus: Bus, tell: Callable[[str], None] = lambda _: None, *, gate: Gate | None = None) -> None:
        self.tell = tell
        self.gate = gate or Gate(bus)
        self._bus = bus
        self._outputs: list[Output] = []
        self._tasks: list[asyncio.Task[None]] = []
        self._loop: asyncio.AbstractEventLoop | None = None

    def add(self, kind: str, settings: Settings, *, commands: Mapping[str, Point[Any]] | None = None) -> None:
        """One more. `commands`: the points that it lets others write. Raises InvalidCommand if an extra is missing."""
        self._outputs.append(self._make(kind, settings, commands or {}))

    def start(self, groups: Iterable[PollGroup]) -> None:
        """From now on, until `close`."""
        self._loop = asyncio.get_running_loop()
        if not self._outputs:
            return
        for output in self._outputs:
            output.start()
        for group in groups:
            takers = [output for output in self._outputs if not output.groups or group.name in output.groups]
            self._begin(self._feed(group.subscribe(WAITING), group, takers))
        self._begin(self._watch())

    def record(self, write: WriteRecord) -> None:
        """Hand a write to all of them."""
        for output in self._outputs:
            output.offer(write)

    async def close(self) -> None:
        """When the bus is closed: what was polled is still handed on, and written within FAREWELL seconds."""
        with anyio.CancelScope(shield=True):
            if self._tasks:
                *feeding, watching = self._tasks
                await asyncio.gather(*feeding, return_exceptions=True)
                watching.cancel()
                await asyncio.gather(watching, return_exceptions=True)
            await asyncio.gather(*(asyncio.to_thread(output.close, FAREWELL) for output in self._outputs))
        self._tasks.clear()

    def statistics(self) -> tuple[OutputStatistics, ...]:
        return tuple(output.statistics() for output in self._outputs)

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Tasks of their own: a task group would tie entering and leaving the line to one task."""
        self._tasks.append(asyncio.ensure_future(work))

    async def _feed(self, cycles: Stream[Snapshot], group: PollGroup, takers: list[Output]) -> None:
        lost = 0
        async for snapshot in cycles:
            for output in takers:
                output.offer(snapshot)
                output.miss((cycles.dropped - lost) * len(group.points))
            lost = cycles.dropped

    async def _watch(self) -> None:
        async for event in self._bus.events():
            text = event_text(event)
            if text:
                node = event.node.label if isinstance(event, NodeChanged | LatenessRaised) else ""
                for output in self._outputs:
                    output.offer(Happening(micros(self._bus.wall_time()), node, text))

    def _say(self, text: str) -> None:
        """From any thread, to the loop; when that is gone nobody listens any more."""
        if self._loop is not None:
            try:
                self._loop.call_soon_threadsafe(self.tell, text)
            except RuntimeError:
                pass

    def _make(self, kind: str, settings: Settings, commands: Mapping[str, Point[Any]]) -> Output:
        match settings:
            case FileSettings():
                return (CsvOutput if kind == "csv" else JsonlOutput)(kind, settings, self._say)
            case SqliteSettings():
                return SqliteOutput(kind, settings, self._say)
            case MqttSettings():
                from busmaster.outputs.mqtt import MqttOutput

                return MqttOutput(kind, settings, self._bus, self._say, commands=commands, gate=self.gate)
            case MetricsSettings():
                from busmaster.outputs.metrics import MetricsOutput

                return MetricsOutput(kind, settings, self._bus, self._say, self.statistics)
            case _:
                raise AssertionError(settings)
