"""The table of the screen: only the lines in sight are drawn, and its cursor stays on its row wherever that goes."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from rich.text import Text
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Region, Size
from textual.scroll_view import ScrollView
from textual.strip import Strip

from busmaster.app.service.picture import Identity, Row

Draw = Callable[[Row, bool], Text]
"""Returns the line of a row, which is the selected one or not."""


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
