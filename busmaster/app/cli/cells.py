"""What stands in the lines of the screen, cut to their widths: a number never loses its magnitude."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal

from rich.text import Text

from busmaster.app.cli.output import value_text
from busmaster.app.service.picture import Frame, Group, Node, Row

BARS = "▁▂▃▄▅▆▇█"
RIPPLE = 0.1
"""Relative change of a value below which no trend is drawn."""
GAUGE = 20
BUSY = 0.9
"""Share of the line's time above which little is left for further requests."""
LEAST = 1e-3
"""Numbers below it are written with an exponent where they are too long."""
COLUMNS = {"NODE": 9, "ITEM": 14, "": 1, "VALUE": 11, "UNIT": 5}
"""Together with HEALTH and AGE, and a space between columns, they fill the 60 columns of a small terminal."""
LAST = {"AGE": 5, "HEALTH": 9}
MORE = {"TREND": 8, "P50ms": 5}
"""What a wider terminal has besides."""
GROWTH = {"ITEM": 12, "NODE": 7, "VALUE": 8, "TREND": 20}
"""How much wider a column gets, in this order, where there is room."""
NUMBERS = ("VALUE", "AGE", "P50ms")
STYLES = {
    "up": "",
    "suspended": "magenta",
    "suspect": "bold magenta",
    "down": "bold reverse",
    "offline": "bold reverse",
}
"""Colours of the health states. Each state also has a word. Colours that a background hides are not used."""
MARKS = {
    "error": ("!", "bold red"),
    "high": ("↑", "bold magenta"),
    "low": ("↓", "bold magenta"),
    "set": ("↑", "bold magenta"),
    "clear": ("↓", "bold magenta"),
    "late": ("~", "magenta"),
    "stale": ("?", "magenta"),
}
"""Beside a value: it could not be read; it is beyond its limit; it came late; it is older than a write to it."""


def sparkline(numbers: Sequence[float | None]) -> str:
    """Draw the last values between their own lowest and highest; a gap where there was none.

    A ripple is not a trend.
    """
    known = [number for number in numbers if number is not None and math.isfinite(number)]
    if not known:
        return ""
    low, high = min(known), max(known)
    span = max(high - low, RIPPLE * max(abs(low), abs(high))) or 1.0
    return "".join(
        " " if x is None or not math.isfinite(x) else BARS[round((x - low) / span * (len(BARS) - 1))] for x in numbers
    )


def age_text(seconds: float | None) -> str:
    """Return an age as `2.5s`, `30s`, `12m` or `3h`; `-` for none."""
    if seconds is None:
        return "-"
    if seconds < 9.95:
        return f"{max(seconds, 0.0):.1f}s"
    if seconds < 600:
        return f"{seconds:.0f}s"
    return f"{seconds / 60:.0f}m" if seconds < 36_000 else f"{seconds / 3600:.0f}h"


def clock_text(seconds: float) -> str:
    """Return seconds as `H:MM:SS`."""
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes // 60:d}:{minutes % 60:02d}:{seconds:02d}"


def fit(text: str, width: int) -> str:
    """Return the text, cut short with an ellipsis if it is wider than `width` columns."""
    return text if len(text) <= width else text[: width - 1] + "…"


def fit_value(value: float | str | None, width: int, precision: int | None = None) -> str:
    """Return a value in at most `width` columns: decimals are left out, or an exponent is written.

    Of several values those at the end are left out.
    """
    text = value_text(value, precision)
    if len(text) <= width:
        return text
    if isinstance(value, int | float):
        return _fit_number(value, width)
    first, comma, _ = text.partition(",")
    if comma and len(first) < width - 1:
        return f"{text[: text.rindex(',', 0, width - 1)]},…"
    try:
        return _fit_number(float(first), width - 2 * len(comma)) + (",…" if comma else "")
    except ValueError:
        return fit(text, width)


def _fit_number(value: float, width: int) -> str:
    if not isinstance(value, int) and not math.isfinite(value):
        return str(value)
    exact = Decimal(repr(value))
    whole = len(f"{exact:.0f}")
    if whole <= width and not 0 < abs(exact) < LEAST:
        text = f"{exact:.{max(0, width - whole - 1)}f}"
        if len(text) <= width:
            return text.rstrip("0").rstrip(".") if "." in text else text
    for digits in range(width, -1, -1):
        mantissa, _, exponent = f"{exact:.{digits}e}".partition("e")
        text = f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"
        if len(text) <= width:
            return text
    return "…"


def right(text: str, width: int, style: str = "") -> Text:
    """Return the text flush right in `width` columns."""
    return Text(fit(text, width).rjust(width), style=style)


def left(text: str, width: int, style: str = "") -> Text:
    """Return the text flush left in `width` columns."""
    return Text(fit(text, width).ljust(width), style=style)


# the head


def title_line(frame: Frame, width: int, trouble: str = "") -> Text:
    """Draw the first line: the title, the port, and the time since the start; or why there is no news."""
    where = f"{frame.line}  {frame.settings}".rstrip()
    line = Text.assemble((f" {frame.title}", "bold"), f"  {where}")
    clock = Text(trouble, "bold reverse") if trouble else Text(clock_text(frame.elapsed))
    line.truncate(max(1, width - len(clock) - 2), overflow="ellipsis", pad=True)
    return Text.assemble(line, " ", clock, " ")


def gauge_line(frame: Frame, width: int) -> Text:
    """Draw how busy the line is, its state, and how many requests wait."""
    gauge = GAUGE if width >= 80 else GAUGE // 2
    filled = min(gauge, round(frame.utilisation * gauge))
    busy = frame.utilisation > BUSY
    line = Text.assemble(
        " line ",
        ("━" * filled, "bold"),
        ("─" * (gauge - filled), "dim"),
        (f" {frame.utilisation:4.0%} busy", "bold magenta" if busy else ""),
        "  ",
        (frame.state, "bold reverse" if frame.state == "offline" else ""),
        f"  {frame.backlog} queued",
    )
    if frame.losses:
        line.append(f"  {frame.losses} disconnect{'s' if frame.losses > 1 else ''}", "bold")
    if frame.read_only:
        line.append("  read-only")
    line.truncate(width, overflow="ellipsis")
    return line


def group_line(group: Group, width: int) -> Text:
    """Draw the line of one poll group: its periods in milliseconds, and its cycles."""
    line = Text.assemble(" ", (group.name, "bold"))
    if group.paused:
        line = Text.assemble(line, "  ", ("paused", "bold reverse"), " ")
    line.append(f" every {group.period * 1000:g} ms  ")
    line.append(f"missed {group.missed}", "bold" if group.missed else "")
    line.append(f"  cycle {group.cycles}")
    if group.achieved:
        line.append(f", achieved {group.achieved * 1000:.1f}, late p99 {group.jitter * 1000:.1f}")
    line.truncate(width, overflow="ellipsis")
    return line


# the table


def column_widths(width: int) -> dict[str, int]:
    """Return the columns, in their order, and the width of each in a terminal of `width` columns."""
    widths = {**COLUMNS, **LAST}
    spare = width - sum(widths.values()) - len(widths) + 1
    more = sum(MORE.values()) + len(MORE)
    if spare >= more:
        widths = {**COLUMNS, "TREND": MORE["TREND"], "AGE": LAST["AGE"], "P50ms": MORE["P50ms"], **LAST}
        spare -= more
    for name, growth in GROWTH.items():
        if name in widths:
            grown = max(0, min(growth, spare))
            widths[name] += grown
            spare -= grown
    return widths


def header_line(widths: dict[str, int]) -> Text:
    """Draw the names of the columns."""
    cells = [(right if name in NUMBERS else left)(name, width) for name, width in widths.items()]
    line = Text(" ").join(cells)
    line.stylize("bold underline")
    return line


def row_line(
    row: Row, node: Node | None, group: Group | None, frame: Frame, widths: dict[str, int], selected: bool = False
) -> Text:
    """Draw the line of one point."""
    fault = "error" if row.error else row.alarm or row.quality
    mark, style = MARKS.get(fault, ("", ""))
    age = None if row.asked is None else max(0.0, frame.now - row.asked)
    paused = group is not None and group.paused
    old = age is not None and group is not None and not paused and age > group.old_after
    health = "offline" if frame.state == "offline" else node.health if node else ""
    cells = {
        "NODE": left(node.label if node else row.node, widths["NODE"]),
        "ITEM": left(row.item, widths["ITEM"]),
        "": Text(mark or " ", style),
        "VALUE": right(fit_value(row.value, widths["VALUE"], row.precision), widths["VALUE"], style or "bold"),
        "UNIT": left(short_unit(row.unit), widths["UNIT"]),
        "AGE": right("rests" if paused else age_text(age), widths["AGE"], "bold magenta" if old else ""),
        "HEALTH": left(health, widths["HEALTH"], STYLES.get(health, "")),
    }
    if "TREND" in widths:
        numbers = [number for _, number in row.past][-widths["TREND"] :]
        cells["TREND"] = left(sparkline(numbers), widths["TREND"])
        cells["P50ms"] = right(f"{node.p50 * 1000:.1f}" if node and node.p50 else "-", widths["P50ms"])
    line = Text(" ").join(cells[name] for name in widths)
    if selected:
        line.stylize("reverse")
    return line


def short_unit(unit: str) -> str:
    """Shorten a unit: a column has no room for "% of rated current"."""
    return unit.partition(" of ")[0]
