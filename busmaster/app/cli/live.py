"""The screen: draws the picture of a line, and sends the user's commands to the line's owner."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
from functools import partial
from typing import Any, ClassVar, Protocol, TypeVar

from rich.text import Text
from textual import events
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.geometry import Region, Size
from textual.screen import ModalScreen
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.widgets import Input, Static

from busmaster import BusError, InvalidCommand
from busmaster.app.cli.app import INTERRUPTED
from busmaster.app.cli.cells import (
    age_text,
    column_widths,
    fit,
    gauge_line,
    group_line,
    header_line,
    row_line,
    sparkline,
    title_line,
)
from busmaster.app.cli.output import number_text, value_text
from busmaster.app.cli.parsing import parse_value
from busmaster.app.cli.terminal import made_printable
from busmaster.app.service.picture import Frame, Group, Identity, Node, Picture, Row, matching

SUSPENDED_FOR = 60.0
SILENT_AFTER = 2.0
"""Seconds without a message from the line's owner before the screen reports that."""
ASKED_EVERY = 1.0
"""Seconds between two questions for the details that are shown."""
EVENTS = 3
ORDERS = ("listed", "item", "oldest", "trouble")
STYLE = """
Screen { background: ansi_default; color: ansi_default; }
Screen Static { background: ansi_default; color: ansi_default; }
#head, #columns, #foot { height: auto; }
"""
KEYS = (
    ("?", "keys"),
    ("q", "quit"),
    ("Enter", "details"),
    ("/", "filter"),
    ("o", "order"),
    ("p", "pause"),
    ("s", "suspend"),
    ("w", "write"),
    ("d", "poll now"),
)
HELP = """\
?       these keys
↑ ↓     another row; also Page up, Page down, Home, End
Enter   details of the row: limits, last exchange, past
/       only rows with some words: node, item, group, health
o       order: by node, by item, oldest first, trouble first
p P     pause the row's group, all groups; again: resume
d D     poll the row's group now, all groups
s       suspend the row's node, or resume it (confirm)
w       write the row's point (confirm)
q       {leave}
Ctrl-C  the same, with exit status 130

!  could not be read: its last good value, growing old
↑ ↓  beyond its limit     ~  came late     ?  older than a write to it"""

Draw = Callable[[Row, bool], Text]
"""Returns the line of a row, which is the selected one or not."""

RECENT = 6
"""Values that are shown as numbers."""
QUALITIES = {"late": "came late", "stale": "older than a write to it"}

T = TypeVar("T")
STYLE_OF_DIALOGS = """
Dialog { align: center bottom; background: transparent; }
Dialog .box { width: 100%; height: auto; max-height: 100%; border: round ansi_default; background: ansi_default;
    color: ansi_default; padding: 0 1; scrollbar-size: 0 0; }
Dialog Static { color: ansi_default; background: ansi_default; width: 1fr; }
Dialog Input { border: none; height: 1; padding: 0; background: ansi_default; color: ansi_default; }
"""
"""Style sheet of the dialogs, which follows that of the screen."""


class Dialog(ModalScreen[T]):
    """Something at the foot of the picture, which stays in sight above it. Escape leaves it."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "leave", show=False)]

    def action_leave(self) -> None:
        """Close the dialog without a result."""
        self.dismiss(None)


class AskYes(Dialog[bool]):
    """Request a confirmation. The result is True for yes, else None."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "agree", show=False),
        Binding("n", "leave", show=False),
    ]

    def __init__(self, question: str) -> None:
        super().__init__()
        self.question = question

    def compose(self) -> ComposeResult:
        with Vertical(classes="box"):
            yield Static(Text(f"{self.question}  y or n"))

    def action_agree(self) -> None:
        """End it with yes."""
        self.dismiss(True)


class AskValue(Dialog[str]):
    """Request a value for `name`, then a confirmation. The result is the value, or None for no."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("n", "leave", show=False),
        Binding("y", "agree", show=False),
    ]

    def __init__(self, name: str, unit: str) -> None:
        super().__init__()
        self.asked = name
        self.unit = unit
        self.value: str | None = None

    def compose(self) -> ComposeResult:
        with Vertical(classes="box"):
            unit = f" in {self.unit}" if self.unit else ""
            yield Static(Text(f"write {self.asked}{unit}  (Enter; Esc cancels)"), id="question")
            yield Input(placeholder="value")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Accept the value and request a confirmation, or show why it is not a number."""
        event.stop()
        if not event.value.strip():
            return
        question = self.query_one("#question", Static)
        try:
            parse_value(event.value)
        except InvalidCommand as error:
            question.update(Text(f"write {self.asked}: {error}  (Enter; Esc cancels)"))
            return
        self.value = event.value.strip()
        event.input.remove()
        question.update(Text(f"write {self.asked} = {f'{self.value} {self.unit}'.rstrip()}?  y or n"))

    def action_agree(self) -> None:
        """End the question with the value, once there is one."""
        if self.value is not None:
            self.dismiss(self.value)


class AskWords(Dialog[str]):
    """Request the words of the row filter. The result is the words; None for no change."""

    def __init__(self, words: str) -> None:
        super().__init__()
        self.words = words

    def compose(self) -> ComposeResult:
        with Vertical(classes="box"):
            yield Static(Text("show rows with (node, item, group, unit, health, error; Enter; empty for all)"))
            yield Input(self.words, placeholder="all")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the words."""
        event.stop()
        self.dismiss(event.value.strip())


class Show(Dialog[None]):
    """Show a text, which may change, until one of its keys is pressed."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter,space,q,question_mark", "leave", show=False),
        Binding("up", "scroll(-1)", show=False),
        Binding("down", "scroll(1)", show=False),
    ]

    def __init__(self, text: Text) -> None:
        super().__init__()
        self.text = text

    def compose(self) -> ComposeResult:
        with VerticalScroll(classes="box"):
            yield Static(self.text, id="text")

    def update(self, text: Text) -> None:
        """Show this text in its place. Ignored while the dialog opens or closes, when it has no place for a text."""
        for shown in self.query("#text").results(Static):
            shown.update(text)

    def action_scroll(self, lines: int) -> None:
        """Go up or down in a text that is longer than the terminal."""
        self.query_one(VerticalScroll).scroll_relative(y=lines, animate=False)


def details_text(
    row: Row, node: Node | None, group: Group | None, details: Mapping[str, Any], frame: Frame | None, width: int
) -> Text:
    """Return the details of a point, for `width` columns. `details` is the description from the line's owner."""
    lines = [Text(f"{row.name}  ({row.key})", "bold")]
    facts = _facts(row, node, group, made_printable(dict(details)), frame)
    lines += [Text.assemble((f"{name:<9}", "bold"), text) for name, text in facts]
    numbers = [number for _, number in row.past if number is not None]
    if numbers:
        trend = [number for _, number in row.past][-width:]
        lines.append(Text(sparkline(trend)))
        recent = [value_text(number, row.precision) for number in reversed(trend[-RECENT:])]
        lines.append(Text(f"of late {'  '.join(recent)}"))
        span = row.past[-1][0] - row.past[0][0]
        lowest, highest = (value_text(one, row.precision) for one in (min(numbers), max(numbers)))
        lines.append(Text(f"{len(row.past)} values in {span:.1f} s, {lowest} to {highest}"))
    return Text("\n").join(lines)


def _facts(
    row: Row, node: Node | None, group: Group | None, details: Mapping[str, Any], frame: Frame | None
) -> Iterator[tuple[str, str]]:
    value = f"{value_text(row.value, row.precision)} {row.unit}".rstrip()
    age = f", requested {age_text(frame.now - row.asked)} ago" if frame and row.asked is not None else ""
    yield "value", value + (f", {QUALITIES[row.quality]}" if row.quality in QUALITIES else "") + age
    if row.alarm:
        yield (
            "alarm",
            f"the bit is {row.alarm}" if row.alarm in ("set", "clear") else f"value beyond its {row.alarm} limit",
        )
    if row.error:
        yield "error", f"{row.error}; {details['hint']}" if details.get("hint") else row.error
    if node is not None:
        state = "offline" if frame and frame.state == "offline" else node.health
        times = f"p50 {node.p50 * 1000:.1f}, p99 {node.p99 * 1000:.1f} ms"
        counts = f"{node.requests} requests, {node.failed} failed, {node.late} late, {times}"
        yield "node", f"{node.kind or node.protocol} {node.address}, {state}: {counts}"
    if group is not None:
        yield "group", f"{group.name}, every {group.period * 1000:g} ms{', paused' if group.paused else ''}"
    if details.get("gone"):
        yield "", str(details["gone"])
    elif details:
        yield "limits", _limits_text(row, details)
        yield "asks", str(details["command"])
        if details.get("timeline"):
            yield "exchange", _exchange_text(details["timeline"])


def _limits_text(row: Row, details: Mapping[str, Any]) -> str:
    texts = []
    for limit in details["limits"]:
        bounds = [
            f"{word} {number_text(limit[name])}"
            for name, word in (("minimum", "from"), ("maximum", "to"), ("max_step", "in steps of at most"))
            if limit[name] is not None
        ]
        texts.append(" ".join(bounds))
    if not all(limit["writable"] for limit in details["limits"]):
        written = "may not be written"
    else:
        written = "written " * row.writable
        written += "; ".join(text for text in texts if text) or ("any value" if row.writable else "it is read-only")
    alarms = [f"{name} {number_text(details[name])}" for name in ("low", "high") if details.get(name) is not None]
    return written + (f"; alarm {', '.join(alarms)}" if alarms else "")


def _exchange_text(times: Mapping[str, Any]) -> str:
    """Return why the last exchange took as long as it did, in milliseconds."""
    queued, started = times["queued"], times["started"]
    attempts = times["attempts"]
    if started is None:
        return f"{attempts} attempts, no reply" if attempts else "not sent"
    parts = [f"waited {_ms(started - queued)}"]
    if times["exchanges_ahead"]:
        parts[0] += f" behind {times['exchanges_ahead']}"
    if times["quiet_time_ahead"]:
        parts[0] += f", {_ms(times['quiet_time_ahead'])} of it while the line resynchronised"
    if times["first_byte"] is not None:
        parts.append(f"reply after {_ms(times['first_byte'] - started)}")
    if times["last_byte"] is not None:
        parts.append(f"whole after {_ms(times['last_byte'] - started)}")
    else:
        parts.append("no reply")
    if attempts != 1:
        parts.append(f"{attempts} attempts")
    return ", ".join(parts)


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.1f} ms"


class Table(ScrollView, can_focus=True):
    """Rows, one of which is selected."""

    DEFAULT_CSS = """
    Table { height: 1fr; background: ansi_default; color: ansi_default; scrollbar-size: 0 0; overflow-x: hidden; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up", "move(-1)", show=False),
        Binding("down", "move(1)", show=False),
        Binding("pageup", "page(-1)", show=False),
        Binding("pagedown", "page(1)", show=False),
        Binding("home", "move(-1000000)", show=False),
        Binding("end", "move(1000000)", show=False),
    ]

    def __init__(self, draw: Draw) -> None:
        super().__init__(id="points")
        self.rows: list[Row] = []
        self._draw = draw
        self._selected: Identity | None = None
        self._index = 0

    @property
    def selected(self) -> Row | None:
        """The selected row, None where there is none."""
        return self.rows[self._index] if self._index < len(self.rows) else None

    def show(self, rows: list[Row]) -> None:
        """Show these rows. The selected one stays so; where it is gone, it is the one in its place."""
        before = self._index, len(self.rows)
        self.rows = rows
        places = (index for index, row in enumerate(rows) if row.identity == self._selected)
        self._select(next(places, min(self._index, max(0, len(rows) - 1))))
        if (self._index, len(rows)) != before:
            self.virtual_size = Size(self.size.width, len(rows))
            self._keep_in_sight()
        self.refresh()

    def _select(self, index: int) -> None:
        self._index = index
        self._selected = self.rows[index].identity if index < len(self.rows) else self._selected

    def _keep_in_sight(self) -> None:
        self.scroll_to_region(Region(0, self._index, 1, 1), animate=False, force=True)

    def action_move(self, rows: int) -> None:
        """Select another row, so many further down."""
        if self.rows:
            self._select(max(0, min(len(self.rows) - 1, self._index + rows)))
            self._keep_in_sight()
            self.refresh()

    def action_page(self, pages: int) -> None:
        """Select a row of the next page, or of the one before."""
        self.action_move(pages * max(1, self.size.height - 1))

    def on_click(self, event: events.Click) -> None:
        """Select the row that was clicked on."""
        self.action_move(event.y + self.scroll_offset.y - self._index)

    def on_resize(self) -> None:
        """Keep the selected row in sight."""
        self.virtual_size = Size(self.size.width, len(self.rows))
        self.call_after_refresh(self._keep_in_sight)

    def render_line(self, y: int) -> Strip:
        """Draw one visible line."""
        index = y + self.scroll_offset.y
        if index >= len(self.rows):
            return Strip.blank(self.size.width, self.rich_style)
        text = self._draw(self.rows[index], index == self._index)
        strip = Strip(text.render(self.app.console), text.cell_len)
        return strip.adjust_cell_length(self.size.width)


class Line(Protocol):
    """What a person may do on a line."""

    async def pause(self, group: str, paused: bool, /) -> None: ...

    async def demand(self, group: str, /) -> None: ...

    async def suspend(self, protocol: str, address: int, for_: float, /) -> None: ...

    async def details(self, group: str, key: str, /) -> Mapping[str, Any]: ...

    async def write(self, group: str, key: str, value: Any, /) -> None: ...


class Screen(App[int]):
    """Draw `picture` whenever `take_picture` reports changes. The result is an exit status."""

    ENABLE_COMMAND_PALETTE = False
    CSS = f"{STYLE}{STYLE_OF_DIALOGS}"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "leave(0)", show=False),
        Binding("ctrl+c", f"leave({INTERRUPTED})", show=False, priority=True),
        Binding("question_mark,h,f1", "help", show=False),
        Binding("enter", "details", show=False),
        Binding("slash", "filter", show=False),
        Binding("o", "order", show=False),
        Binding("p", "pause(False)", show=False),
        Binding("P", "pause(True)", show=False),
        Binding("d", "demand(False)", show=False),
        Binding("D", "demand(True)", show=False),
        Binding("s", "suspend", show=False),
        Binding("w", "write", show=False),
    ]

    def __init__(self, picture: Picture, line: Line, *, read_only: bool = False, leave: str = "leave") -> None:
        super().__init__(ansi_color=True)  # the terminal's own colours; and none at all with NO_COLOR
        self.picture = picture
        self.line = line
        self.read_only = read_only
        self.leave = leave
        """What q does, in words."""
        self.words = ""
        self.order = ORDERS[0]
        self.last_message: tuple[float, str] | None = None
        """What became of the last wish, and when."""
        self.away = ""
        """Why the line's owner is not there, "" while it is."""
        self.heard = time.monotonic()
        self.head = Static(id="head")
        self.columns = Static(id="columns")
        self.table = Table(self._row_line)
        self.foot = Static(id="foot")
        self._widths = column_widths(80)
        self._frame: Frame | None = None
        """The time base of the drawn rows: `picture` may already belong to a new owner."""
        self._of_node: Mapping[tuple[str, int], Node] = {}
        self._of_group: Mapping[str, Group] = {}
        self._due = False

    def compose(self) -> ComposeResult:
        yield from (self.head, self.columns, self.table, self.foot)

    def on_mount(self) -> None:
        """Begin to draw."""
        self.theme = "ansi-dark"
        self.table.focus()
        self.set_interval(SILENT_AFTER / 2, self.draw)
        self.draw()

    def on_resize(self) -> None:
        """Fit the picture to the terminal's new size."""
        self.call_after_refresh(self.draw)

    # drawing

    def take_picture(self) -> None:
        """Draw what there is news of, soon. May be called from outside."""
        self.heard = time.monotonic()
        if not self._due and self.is_running:
            self._due = True
            self.call_later(self.draw)

    def draw(self) -> None:
        """Draw the whole screen."""
        self._due = False
        frame = self.picture.frame
        if frame is None:
            self.head.update(Text(fit(" waiting for the program that owns the line", self.size.width)))
            return
        self._widths = column_widths(self.size.width)
        self._frame = frame
        self._of_node = self.picture.nodes
        groups = self.picture.groups
        self._of_group = {group.name: group for group in groups}
        self.table.show(self._rows())
        self.head.update(self._head(frame, groups))
        self.columns.update(header_line(self._widths))
        self.foot.update(self._foot(frame))

    def _rows(self) -> list[Row]:
        places = {key: place for place, key in enumerate(self._of_node)}
        rows = sorted(
            matching(self.picture.rows, self._of_node, self.words),
            key=lambda row: places.get((row.protocol, row.address), len(places)),
        )
        match self.order:
            case "item":
                rows.sort(key=lambda row: row.item)
            case "oldest":
                rows.sort(key=lambda row: -1.0 if row.asked is None else row.asked)
            case "trouble":
                rows.sort(key=self._soundness)
        return rows

    def _soundness(self, row: Row) -> tuple[bool, bool, bool, bool]:
        node = self._of_node.get((row.protocol, row.address))
        up = node is not None and node.health == "up"
        return not row.error, up, not row.alarm, row.quality not in ("late", "stale")

    def _row_line(self, row: Row, selected: bool) -> Text:
        assert self._frame is not None
        node, group = self._of_node.get((row.protocol, row.address)), self._of_group.get(row.group)
        return row_line(row, node, group, self._frame, self._widths, selected)

    def _head(self, frame: Frame, groups: list[Group]) -> Text:
        width, room = self.size.width, max(1, self.size.height // 8)
        lines = [title_line(frame, width, self._trouble()), gauge_line(frame, width)]
        shown = groups
        if len(groups) > room:  # the selected row's is among those that are shown
            row = self.table.selected
            first = [group for group in groups if row is not None and group.name == row.group]
            shown = (first + [group for group in groups if group not in first])[: max(1, room - 1)]
        lines += [group_line(group, width) for group in shown]
        if len(shown) < len(groups):
            lines.append(Text(fit(f" and {len(groups) - len(shown)} more groups", width)))
        if frame.left_out:
            lines.append(Text(fit(f" {frame.left_out} points more than are shown", width), "bold"))
        return Text("\n").join(lines)

    def _trouble(self) -> str:
        """Return why the shown data may be old, "" if it is current."""
        silent = time.monotonic() - self.heard
        if self.away:
            return "its owner is not running"
        return f"no data for {silent:.0f} s" if silent > SILENT_AFTER else ""

    def _foot(self, frame: Frame) -> Text:
        width, row = self.size.width, self.table.selected
        lines: list[Text] = []
        if self.away:
            lines.append(Text(fit(f" {self.away}", width), "bold"))
        if row is not None and row.error:
            lines.append(Text(fit(f" {row.name}: {row.error}", width), "bold"))
        happened = [*frame.events, *([self.last_message] if self.last_message else [])]
        began = frame.now - frame.elapsed
        for when, text in sorted(happened)[-EVENTS if self.size.height >= 24 else -1 :]:
            lines.append(Text(fit(f" {when - began:7.1f} s  {text}", width)))
        shown = [
            text for text in (self.words and f"filter: {self.words}", self.order != "listed" and self.order) if text
        ]
        lines.append(keys_line(width, self.leave, ", ".join(shown)))
        return Text("\n").join(lines)

    # what the person wishes

    def _start_request(self, what: str, doing: Callable[[], Coroutine[Any, Any, None]], done: str = "") -> None:
        """Run a command in the background, and show its result."""

        async def run() -> None:
            try:
                await doing()
            except (BusError, InvalidCommand) as error:
                self._show_message(f"{what}: {error.what if isinstance(error, BusError) else error}")
            else:
                if done:
                    self._show_message(done)

        self.run_worker(run(), exit_on_error=False)

    def _show_message(self, text: str) -> None:
        self.last_message = (self.picture.frame.now if self.picture.frame else 0.0), text
        self.draw()

    def action_leave(self, status: int) -> None:
        """End it."""
        self.exit(status)

    def action_help(self) -> None:
        """Show the keys."""
        self.push_screen(Show(Text(HELP.format(leave=self.leave))))

    def action_filter(self) -> None:
        """Open the dialog for the row filter."""

        def take(words: str | None) -> None:
            if words is not None:
                self.words = words
                self.draw()

        self.push_screen(AskWords(self.words), take)

    def action_order(self) -> None:
        """Show the rows in another order."""
        self.order = ORDERS[(ORDERS.index(self.order) + 1) % len(ORDERS)]
        self.draw()

    def _chosen(self, all_groups: bool) -> list[Group]:
        row = self.table.selected
        return [group for group in self._of_group.values() if all_groups or (row and group.name == row.group)]

    def action_pause(self, all_groups: bool) -> None:
        """Pause the row's group or all groups, or resume the paused ones."""
        groups = self._chosen(all_groups)
        paused = not all(group.paused for group in groups)
        for group in groups:
            what = f"{'pause' if paused else 'resume'} {group.name}"
            self._start_request(what, partial(self.line.pause, group.name, paused))

    def action_demand(self, all_groups: bool) -> None:
        """Poll the row's group, or all groups, now."""
        for group in self._chosen(all_groups):
            self._start_request(f"poll {group.name}", partial(self.line.demand, group.name))

    def action_suspend(self) -> None:
        """Suspend or resume the row's node, after a confirmation."""
        row = self.table.selected
        node = self._of_node.get((row.protocol, row.address)) if row is not None else None
        if node is None:
            return
        rests = node.health == "suspended"
        question = f"resume {node.label}" if rests else f"suspend {node.label} for {SUSPENDED_FOR:.0f} s, all its polls"

        def take(meant: bool | None) -> None:
            if meant:
                seconds = 0.0 if rests else SUSPENDED_FOR
                self._start_request(question, partial(self.line.suspend, node.protocol, node.address, seconds))

        self.push_screen(AskYes(f"{question}?"), take)

    def action_write(self) -> None:
        """Write the selected point, after dialogs for the value and a confirmation."""
        row, frame = self.table.selected, self.picture.frame
        if row is None or frame is None:
            return
        if self.read_only or frame.read_only or not row.writable:
            self._show_message(f"{row.name} is read-only" if not row.writable else "this view is read-only")
            return

        def take(text: str | None) -> None:
            if text is not None:
                name = f"{row.name} = {text}"
                writing = partial(self.line.write, row.group, row.key, parse_value(text))
                self._start_request(name, writing, f"{name} written")

        self.push_screen(AskValue(row.name, row.unit), take)

    def action_details(self) -> None:
        """Show all that is known of the selected point, as it changes."""
        row = self.table.selected
        if row is None:
            return
        shown = Show(self._details(row, {}))

        async def follow() -> None:
            await self.push_screen(shown)
            while shown.is_attached:
                try:
                    details = await self.line.details(row.group, row.key)
                except (BusError, InvalidCommand) as error:
                    details = {"gone": str(error)}
                shown.update(self._details(row, details))
                await asyncio.sleep(ASKED_EVERY)

        self.run_worker(follow(), exit_on_error=False)

    def _details(self, row: Row, details: Mapping[str, Any]) -> Text:
        now = next((one for one in self.picture.rows if one.identity == row.identity), row)
        node, group = self._of_node.get((row.protocol, row.address)), self._of_group.get(row.group)
        return details_text(now, node, group, details, self.picture.frame, max(20, self.size.width - 4))


def keys_line(width: int, leave: str, shown: str) -> Text:
    """Draw the keys, as many as there is space for, and the state of order and filter."""
    line = Text(f" {shown} " if shown else " ", "reverse" if shown else "")
    for key, label in KEYS:
        more = Text.assemble((key, "bold"), f" {leave if key == 'q' else label}  ")
        if line.cell_len + more.cell_len > width:
            break
        line = Text.assemble(line, more) if line.cell_len > 1 else Text.assemble(" ", more)
    return line
