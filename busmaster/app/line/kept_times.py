"""Stores the learned reply times of a line in a file, with which the next run starts.

Stored times are only a hint. They are trusted after fewer replies, and never make a window longer than the document's.
A damaged file is ignored as a whole. Wrong times cost time and nothing else.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from hashlib import sha256
from typing import Any

import anyio

from busmaster import Bus, Node, ext
from busmaster.ext import LearnedTimes, open_file, read_file

VERSION = 2
"""Of the file's form. Another one is started anew."""
KEEP_EVERY = 600.0
"""Seconds from one keeping to the next, while the line runs."""
PATIENCE = 5.0
"""Seconds for which a disk may hold up the start or the end of a line."""
ANEW, NOT_KEPT = "reply times are learned again", "the learned reply times are not stored"
SLICE = 16
"""Nodes whose times are taken at once, before the loop may go on with the line."""


class KeptTimes:
    """The file of one line. `report` is called, on the loop, with an error of the file, once until it changes."""

    def __init__(self, bus: Bus, report: Callable[[str], None]) -> None:
        self._bus = bus
        self._report = report
        self._path: str | None = None
        self._nodes: Mapping[str, Node] = {}
        self._known: Mapping[str, Any] = {}
        """Contents of the file when the line was opened."""
        self._kept = ""
        self._trouble = self._reported = ""
        self._keeping: asyncio.Task[None] | None = None
        self._thread: threading.Thread | None = None
        self._one_at_a_time = threading.Lock()

    async def start(self, path: str | None, nodes: Mapping[str, Node]) -> None:
        """Load the times of these nodes from the file, and update the file from now on. None stores nothing."""
        if path is not None:
            await asyncio.to_thread(self._do, ANEW, self._read, path)
        self.take(path, nodes)

    def take(self, path: str | None, nodes: Mapping[str, Node]) -> None:
        """Continue with these nodes and this file. New nodes start with the times loaded at the start."""
        fresh = {name: node for name, node in nodes.items() if node not in self._nodes.values()}
        if path != self._path:
            self._kept = ""  # the other file does not have these times yet
        self._path, self._nodes = path, dict(nodes)
        for name, node in fresh.items():
            if name in self._known and self._known[name]["settings"] == self._settings(node):
                ext.begin_with(node, _times(self._known[name]))
        if path is not None and self._keeping is None:
            self._keeping = asyncio.ensure_future(self._keep_often())
        self._report_trouble()

    async def close(self) -> None:
        """Store the present times, and stop."""
        if self._keeping is None:
            return
        self._keeping.cancel()
        with anyio.CancelScope(shield=True):
            await asyncio.gather(self._keeping, return_exceptions=True)
            await self._keep()
        self._keeping = None

    async def _keep_often(self) -> None:
        while True:
            await asyncio.sleep(KEEP_EVERY)
            await self._keep()

    async def _keep(self) -> None:
        path, kept = self._path, {}
        if path is None:
            return
        for number, (name, node) in enumerate(list(self._nodes.items())):
            if number % SLICE == SLICE - 1:
                await asyncio.sleep(0)
            if times := ext.times_to_keep(node):
                kept[name] = {"settings": self._settings(node), "times": [asdict(each) for each in times]}
        await asyncio.to_thread(self._do, NOT_KEPT, self._write, path, kept)
        self._report_trouble()

    def _report_trouble(self) -> None:
        if self._trouble and self._trouble != self._reported:
            self._report(self._trouble)
        self._reported = self._trouble

    def _settings(self, node: Node) -> str:
        """Return a mark of all that its reply times depend on: with another one they are learned anew."""
        where = self._bus.endpoint
        port = (where.name, where.settings, where.echo, where.receive_latency)
        return sha256(repr((port, node.profile.name, node.address, node.timings)).encode()).hexdigest()[:16]

    # in a thread

    def _do(self, without: str, work: Callable[..., None], path: str, *arguments: Any) -> None:
        """Read or write, in a thread of its own: a disk that hangs must not keep the process from ending."""
        with self._one_at_a_time:  # a line that is closed leaves a writer behind that was cancelled
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(
                    target=work, args=(path, *arguments), name="busmaster times", daemon=True
                )
                self._thread.start()
            self._thread.join(PATIENCE)
            if self._thread.is_alive():
                self._trouble = f"{path}: the file system did not respond for {PATIENCE:g} s; {without}"

    def _read(self, path: str) -> None:
        try:
            data = json.loads(read_file(path))
            if data["version"] != VERSION:
                raise ValueError("of another version")
            for node in data["nodes"].values():
                str(node["settings"])
                _times(node)
            self._known = data["nodes"]
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            self._trouble = f"{path}: {_why(error)}; {ANEW}"

    def _write(self, path: str, nodes: Mapping[str, Any]) -> None:
        """Put the file in the place of the one before, whole."""
        text = json.dumps({"version": VERSION, "nodes": nodes}, indent=1)
        if not nodes or text == self._kept:
            return  # too little is known yet: what an earlier run has kept stays
        fresh = f"{path}.new"
        try:
            with open(open_file(fresh, os.O_TRUNC | os.O_WRONLY), "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.replace(fresh, path)
        except OSError as error:
            self._trouble = f"{path}: {_why(error)}; {NOT_KEPT}"
        else:
            self._kept, self._trouble = text, ""


def _why(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "the file is damaged, or from another version"


def _times(node: Any) -> list[LearnedTimes]:
    """Return the times of one node in a file. Raises ValueError, TypeError or KeyError for invalid contents."""
    found = [LearnedTimes(**data) for data in node["times"]]
    for times in found:
        seconds = (times.slowest, times.received, times.pause, times.window)
        if not (type(times.kind) is str and type(times.packet) is type(times.trusted) is bool):
            raise ValueError("kind must be a text, packet and trusted true or false")
        if not all(type(time) in (int, float) and 0 <= time < math.inf for time in seconds):
            raise ValueError("a time must be a number of seconds")
    return found
