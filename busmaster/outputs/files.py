"""CSV and JSON lines: a file that grows by whole lines."""

from __future__ import annotations

import csv
import io
import os
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime

from busmaster.bus.polling import Snapshot
from busmaster.outputs.base import BatchOutput, Happening, Item, check_folder
from busmaster.outputs.settings import FileSettings
from busmaster.outputs.values import cycle_fields, json_line, value_text

COLUMNS = ("time", "group", "cycle", "node", "item", "value", "unit", "quality", "error")


class FileOutput(BatchOutput[bytes]):
    """Appends to the file; begins another when the date in its name changes."""

    def __init__(
        self,
        kind: str,
        settings: FileSettings,
        clock: Callable[[], float] = time.monotonic,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(kind, settings, clock, say)
        check_folder(time.strftime(settings.path))
        self._pattern = settings.path
        self._path = ""
        self._descriptor: int | None = None

    def head(self) -> bytes:
        """What a file begins with."""
        return b""

    def commit(self, batch: list[bytes]) -> None:
        """A batch that the disk has no room for is cut off again."""
        descriptor = self._open()
        end = os.lseek(descriptor, 0, os.SEEK_END)
        rest = memoryview((b"" if end else self.head()) + b"".join(batch))
        try:
            while rest:
                rest = rest[os.write(descriptor, rest) :]
        except OSError:
            os.ftruncate(descriptor, end)
            raise

    def shut(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _open(self) -> int:
        path = time.strftime(self._pattern)
        if path != self._path:
            self.shut()
            self._path = path
        if self._descriptor is None:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        return self._descriptor


class CsvOutput(FileOutput):
    """A line a value. Times are UTC, to the millisecond."""

    def head(self) -> bytes:
        return csv_lines([COLUMNS])

    def format(self, item: Item, time_of: Callable[[float], float]) -> bytes | None:
        if isinstance(item, Happening):
            return None
        return csv_lines(
            (
                utc(time_of(sample.finished)),
                item.group,
                item.cycle,
                point.key.partition("/")[0],
                point.item,
                "" if sample.error else value_text(sample.value),
                point.unit,
                sample.quality.value,
                sample.error.what if sample.error else "",
            )
            for point, sample in self.unhurried(item)
        )


class JsonlOutput(FileOutput):
    """A line a cycle, as `busmaster run --json` prints it, and a line an event. Times are seconds since 1970."""

    def format(self, item: Item, time_of: Callable[[float], float]) -> bytes:
        if isinstance(item, Snapshot):
            fields = cycle_fields(item, time_of)
        else:
            fields = {"event": item.text, "node": item.node or None, "time": time_of(item.time)}
        return json_line(**fields).encode() + b"\n"


def csv_lines(rows: Iterable[Iterable[object]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def utc(moment: float) -> str:
    return datetime.fromtimestamp(moment, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
