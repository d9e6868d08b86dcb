"""CSV and JSON lines: a file that grows by whole lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from busmaster import Sample, Snapshot
from busmaster.app.outputs.base import Item, OutputKind, check_folder
from busmaster.app.outputs.batches import BatchOutput
from busmaster.app.outputs.cells import csv_lines, no_formula
from busmaster.app.outputs.growing_file import GrowingFile
from busmaster.app.outputs.settings import FileSettings
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.values import cycle_fields, json_line, micros, utc, value_text, write_fields

COLUMNS = ("time", "group", "cycle", "node", "item", "value", "unit", "quality", "error")


class FileOutput(BatchOutput[bytes]):
    """Appends to the file; begins another when the date in its name changes, or when it was moved away."""

    head = b""
    """What a file begins with."""

    def __init__(
        self,
        kind: str,
        settings: FileSettings,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(kind, settings, report)
        check_folder(settings.path)
        self._file = GrowingFile(
            settings.path,
            mode=settings.mode,
            sync_every=settings.sync_every,
            head=self.head,
            report=lambda text: report(f"{kind}: {text}"),
        )

    def commit(self, batch: list[bytes]) -> None:
        self._file.append(b"".join(batch), sync=self.must_sync)

    def pack(self, formatted: bytes) -> str:
        return formatted.decode()

    def unpack(self, text: str) -> bytes:
        return text.encode()

    def shut(self) -> None:
        self._file.close()


class CsvOutput(FileOutput):
    """One line per value. Times are UTC, to the millisecond. Names are safe from interpretation as formulas."""

    head = ",".join(COLUMNS).encode() + b"\n"

    def format(self, item: Item) -> bytes | None:
        """Return a line for each value of a cycle; None for the rest, which is not written here."""
        if not isinstance(item, Snapshot):
            return None
        return csv_lines(
            (
                utc(micros(sample.wall)),
                no_formula(item.group),
                item.cycle,
                no_formula(point.key.partition("/")[0]),
                no_formula(point.item),
                value_cell(sample),
                no_formula(point.unit),
                sample.quality.value,
                no_formula(sample.error.what) if sample.error else "",
            )
            for point, sample in self.unhurried(item)
        )


class JsonlOutput(FileOutput):
    """A line a cycle, as `busmaster run --json` prints it, a line an event and a line a write.

    Times are seconds since 1970.
    """

    def format(self, item: Item) -> bytes:
        """Return one line of JSON for a cycle, an event or a write."""
        if isinstance(item, Snapshot):
            fields = cycle_fields(item, item.wall_at)
        elif isinstance(item, WriteRecord):
            fields = {"write": item.point, **write_fields(item)}
        else:
            fields = {"event": item.text, "node": item.node or None, "time": item.time}
        return json_line(**fields).encode() + b"\n"


def value_cell(sample: Sample[Any]) -> str:
    """Return a value as text. Only a text could be interpreted as a formula."""
    if sample.error:
        return ""
    text = value_text(sample.value)
    return no_formula(text) if isinstance(sample.value, str) else text


CSV = OutputKind(
    name="csv",
    settings=FileSettings,
    make=lambda settings, line: CsvOutput("csv", settings, line.report),
    about="Values as lines of a CSV file.",
    without=("audit",),
)
JSONL = OutputKind(
    name="jsonl",
    settings=FileSettings,
    make=lambda settings, line: JsonlOutput("jsonl", settings, line.report),
    about="Values and events as lines of JSON.",
    keeps_audit=True,
)
