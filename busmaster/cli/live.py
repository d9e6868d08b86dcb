"""The screen: a process of its own that draws frames and sends back keys, so that drawing never disturbs the line.

Started by `watch` as `python -m busmaster.cli.live DESCRIPTOR`, a connected socket. It ends when the socket does.
Only the terminal's own colours are used: those that a light background swallows (yellow, white) are not.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from collections import defaultdict, deque
from collections.abc import Sequence
from typing import Any, ClassVar

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.screen import Screen as TextualScreen
from textual.widgets import DataTable, Footer, Static

from busmaster.cli.dialog import AskValue
from busmaster.cli.messages import Action, Frame, GroupRow, NodeRow, Row, decode_frame, encode
from busmaster.cli.output import value_text

FRAME_LIMIT = 1 << 22
"""Bytes of the longest frame: some ten thousand points."""
BARS = "▁▂▃▄▅▆▇█"
RIPPLE = 0.1
GAUGE = 20
EVENTS = 3
HEALTH_STYLES = {
    "up": "green",
    "suspended": "magenta",
    "unknown": "dim",
    "suspect": "bold magenta",
    "down": "reverse red",
}
COLUMNS = {"NODE": 8, "ITEM": 16, "VALUE": 10, "UNIT": 6, "TREND": 6, "AGE": 4, "P50ms": 5, "HEALTH": 9}
"""With a space on each side of a column these are the 80 columns of the smallest terminal."""
GROWTH = {"ITEM": 8, "VALUE": 10, "TREND": 16}
"""How much wider a column gets, in this order, where the terminal is wider."""
LONGEST_TREND = COLUMNS["TREND"] + GROWTH["TREND"]
NUMBERS = ("VALUE", "AGE", "P50ms")
OLD_AFTER = 3
"""Periods after which a value's age is worth a look."""


def sparkline(numbers: Sequence[float | None]) -> str:
    """Draw the last values between their own lowest and highest; a gap where there was none.

    A ripple is not a trend.
    """
    known = [number for number in numbers if number is not None]
    if not known:
        return ""
    low, high = min(known), max(known)
    span = max(high - low, RIPPLE * max(abs(low), abs(high))) or 1.0
    return "".join(" " if x is None else BARS[round((x - low) / span * (len(BARS) - 1))] for x in numbers)


def age_text(seconds: float | None) -> str:
    """Return an age as `2.5s`, `30s` or `12m`; `-` for none."""
    if seconds is None:
        return "-"
    if seconds < 10:
        return f"{seconds:.1f}s"
    return f"{seconds:.0f}s" if seconds < 600 else f"{seconds / 60:.0f}m"


def clock_text(seconds: float) -> str:
    """Return seconds as `H:MM:SS`."""
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes // 60:d}:{minutes % 60:02d}:{seconds:02d}"


def fit(text: str, width: int) -> str:
    """Return the text, cut short with an ellipsis if it is wider than `width` columns."""
    return text if len(text) <= width else text[: width - 1] + "…"


def title_line(frame: Frame, width: int) -> Text:
    """Draw the first line: the title, the port, and the time since the start."""
    left = Text.assemble((f" {frame.title}", "bold"), f"  {frame.port}")
    clock = clock_text(frame.now)
    left.truncate(width - len(clock) - 2, overflow="ellipsis", pad=True)
    return left + Text(f" {clock} ")


def gauge_line(frame: Frame) -> Text:
    """Draw how busy the line is, its state, and how many requests wait."""
    filled = min(GAUGE, round(frame.utilisation * GAUGE))
    style = "red" if frame.utilisation > 0.9 else "green"
    return Text.assemble(
        " line ",
        ("━" * filled, style),
        ("─" * (GAUGE - filled), "dim"),
        f" {frame.utilisation:4.0%} busy  ",
        (frame.line, "" if frame.line == "ready" else "bold red"),
        f"  {frame.backlog} waiting",
    )


def group_line(group: GroupRow) -> Text:
    """Draw the line of one poll group: its periods in milliseconds, and its cycles."""
    line = Text.assemble(" ", (group.name, "bold"), f" every {group.period * 1000:g} ms")
    if group.achieved is not None:
        line.append(f", achieved {group.achieved * 1000:.1f}")
        if group.p99 is not None:
            line.append(f" (p99 {group.p99 * 1000:.1f})")
    line.append(f"  cycle {group.cycles}  ")
    line.append(f"missed {group.missed}", style="bold red" if group.missed else "")
    if group.paused:
        line.append("  paused", style="bold magenta")
    return line


def column_widths(width: int) -> dict[str, int]:
    """Return the width of each column in a terminal of `width` columns."""
    widths = dict(COLUMNS)
    spare = width - sum(widths.values()) - 2 * len(widths)
    for name, growth in GROWTH.items():
        more = max(0, min(growth, spare))
        widths[name] += more
        spare -= more
    return widths


def right(text: str, width: int, style: str = "") -> Text:
    """Return the text flush right in `width` columns."""
    return Text(fit(text, width).rjust(width), style=style)


class Screen(App[None]):
    """Draws what `take_frame` is given. `send` carries the person's actions."""

    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { background: ansi_default; color: ansi_default; }
    #head { height: auto; }
    #points { height: 1fr; background: ansi_default; color: ansi_default;
        scrollbar-size: 0 1; }
    #points > .datatable--header { background: ansi_default; color: ansi_default; text-style: bold underline; }
    #points > .datatable--cursor { background: ansi_default; color: ansi_default; text-style: reverse; }
    #points > .datatable--hover { background: ansi_default; }
    #events { height: auto; max-height: 4; text-style: dim; }
    Toast { background: ansi_default; color: ansi_default; }
    Footer { background: ansi_default; color: ansi_default; }
    FooterKey { background: ansi_default; color: ansi_default; }
    FooterKey .footer-key--key { background: ansi_default; color: ansi_blue; text-style: bold; }
    FooterKey .footer-key--description { background: ansi_default; color: ansi_default; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "leave('quit')", "quit"),
        Binding("ctrl+c", "leave('interrupt')", show=False, priority=True),
        Binding("p", "ask('pause')", "pause polling"),
        Binding("d", "ask('demand')", "poll now"),
        Binding("s", "suspend", "suspend node"),
        Binding("w", "write", "write value"),
        Binding("up,down,pageup,pagedown", "scroll", "scroll", key_display="↑↓", show=True),
    ]

    def __init__(self, connection: socket.socket | None) -> None:
        super().__init__()
        self.connection = connection
        self.writer: asyncio.StreamWriter | None = None
        self.frame: Frame | None = None
        self.trends: defaultdict[tuple[int, str, str], deque[float | None]] = defaultdict(
            lambda: deque(maxlen=LONGEST_TREND)
        )
        self.shown: list[tuple[str, str]] = []
        self.widths = dict(COLUMNS)

    def compose(self) -> ComposeResult:
        yield Static(id="head")
        yield DataTable(id="points", cursor_type="row", cursor_foreground_priority="renderable")
        yield Static(id="events")
        yield Footer(show_command_palette=False)

    def on_mount(self) -> None:
        """Begin to hear the connection."""
        self.theme = "ansi-dark"
        self.table.focus()
        if self.connection is not None:
            self.run_worker(self.listen(self.connection), exit_on_error=True)

    def on_resize(self) -> None:
        """Fit the columns to the terminal's new width."""
        self.widths = column_widths(self.size.width)
        self.shown = []
        self.table.clear(columns=True)
        for name, width in self.widths.items():
            self.table.add_column(right(name, width) if name in NUMBERS else Text(name), width=width, key=name)
        if self.frame:
            self.take_frame(self.frame)

    @property
    def base(self) -> TextualScreen[object]:
        """The picture, under whatever question is open."""
        return self.screen_stack[0]

    @property
    def selected(self) -> Row | None:
        """The row under the cursor, None where there is none."""
        rows, index = self.frame.rows if self.frame else (), self.table.cursor_row
        return rows[index] if index < len(rows) else None

    @property
    def table(self) -> DataTable[Text]:
        """The table of the points."""
        table: DataTable[Text] = self.base.query_one("#points", DataTable)
        return table

    async def listen(self, connection: socket.socket) -> None:
        """Take every frame that the connection brings; end the screen when it ends."""
        # asyncio's own limit, 64 KiB a line, raises at some hundred points
        reader, self.writer = await asyncio.open_connection(sock=connection, limit=FRAME_LIMIT)
        try:
            while line := await reader.readline():
                self.take_frame(decode_frame(line))
            self.exit()
        finally:
            self.writer.close()

    def send(self, action: Action) -> None:
        """Send what the person asked for, as long as somebody is there to hear it."""
        if self.writer is not None and not self.writer.is_closing():
            self.writer.write(encode(action))

    def action_leave(self, kind: Any) -> None:
        """Say that the person leaves, and end."""
        self.send(Action(kind))
        self.exit()

    def action_ask(self, kind: Any) -> None:
        """Send an action on all groups."""
        self.send(Action(kind))

    def action_suspend(self) -> None:
        """Ask for the selected point's node to be suspended, or to go on."""
        row = self.selected
        if row is not None:
            self.send(Action("suspend", row.node))

    def action_write(self) -> None:
        """Ask for a value of the selected point, and again whether to write it."""
        row = self.selected
        if row is None or self.frame is None:
            return
        if self.frame.read_only or not row.writable:
            # a name may have brackets, which would be taken for markup
            self.notify(f"{row.node} {row.item} is read-only", markup=False)
            return

        def send(value: str | None) -> None:
            if value is not None:
                self.send(Action("write", row.node, row.item, value))

        self.push_screen(AskValue(f"{row.node} {row.item}", row.unit), send)

    def action_scroll(self) -> None:
        """Stand in the footer for the table's own keys."""

    def take_frame(self, frame: Frame) -> None:
        """Draw this frame."""
        self.frame = frame
        width = self.size.width
        head = [title_line(frame, width), gauge_line(frame), *map(group_line, frame.groups)]
        self.base.query_one("#head", Static).update(Text("\n").join(head))
        events = frame.events[-EVENTS:]
        self.base.query_one("#events", Static).update(Text("\n".join(fit(f" {event}", width) for event in events)))
        self.draw_rows(frame)

    def draw_rows(self, frame: Frame) -> None:
        """Draw the points of a frame: only the cells that have changed, unless other points are shown."""
        table, nodes = self.table, {node.label: node for node in frame.nodes}
        keys = [(row.node, row.item) for row in frame.rows]
        if keys != self.shown:
            table.clear()
            self.shown = keys
            for number in range(len(keys)):
                table.add_row(*(Text() for _ in COLUMNS), key=str(number))  # two groups may have the same point
        old = OLD_AFTER * max((group.period for group in frame.groups), default=1.0)
        before = ""
        for number, row in enumerate(frame.rows):
            trend = self.trends[number, row.node, row.item]
            trend.append(row.value if isinstance(row.value, int | float) and not row.error else None)
            cells = point_cells(row, list(trend)[-self.widths["TREND"] :], old, self.widths)
            if row.node != before:
                cells |= node_cells(nodes.get(row.node, NodeRow(row.node, "")), self.widths)
            for name, cell in cells.items():
                shown = table.get_cell(str(number), name)
                if (shown, shown.style) != (cell, cell.style):  # texts are equal to rich whatever their style
                    table.update_cell(str(number), name, cell)
            before = row.node


def point_cells(row: Row, trend: list[float | None], old: float, widths: dict[str, int]) -> dict[str, Text]:
    """Return the cells of one point. An age beyond `old` seconds stands out."""
    style = "red" if row.error else "magenta" if row.late else "bold"
    return {
        "ITEM": Text(fit(row.item, widths["ITEM"])),
        "VALUE": right(value_text(row.value, row.precision), widths["VALUE"], style),
        "UNIT": Text(fit(row.unit, widths["UNIT"])),
        "TREND": Text(sparkline(trend), style="blue"),
        "AGE": right(age_text(row.age), widths["AGE"], "red" if row.age is not None and row.age > old else ""),
    }


def node_cells(node: NodeRow, widths: dict[str, int]) -> dict[str, Text]:
    """Return the cells of a node, which stand beside the node's first point."""
    return {
        "NODE": Text(fit(node.label, widths["NODE"]), style="bold"),
        "P50ms": right(f"{node.p50 * 1000:.1f}" if node.requests else "", widths["P50ms"]),
        "HEALTH": Text(fit(node.health, widths["HEALTH"]), style=HEALTH_STYLES.get(node.health, "")),
    }


def main() -> int:
    """Draw until the socket ends. The one argument is its descriptor."""
    connection = socket.socket(fileno=int(sys.argv[1]))
    connection.setblocking(False)
    screen = Screen(connection)
    screen.run()
    return screen.return_code or 0


if __name__ == "__main__":
    sys.exit(main())
