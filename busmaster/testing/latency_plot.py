"""The plot of a bench: a histogram of the latency, and the latency over time. It needs matplotlib."""

from __future__ import annotations

import os
from typing import Any

from busmaster.errors import InvalidCommand
from busmaster.testing.latency_report import BenchReport, milliseconds

SIZE = (12.0, 5.0)
"""Inches."""
MOST_DOTS = 20_000
"""Of each class: with more a vector file takes megabytes and shows nothing more."""
MARKED = ("p50", "p99", "max")


def check_plot(path: str) -> None:
    """Raise InvalidCommand if no plot can be written to a path: without matplotlib, for an unknown suffix or folder."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
    except ImportError:
        raise InvalidCommand(
            "a plot needs matplotlib, which the extra named plots brings: pip install 'busmaster[plots]'"
        ) from None
    suffix = os.path.splitext(path)[1].lstrip(".").lower()
    known = FigureCanvasAgg.get_supported_filetypes()
    if suffix not in known:
        raise InvalidCommand(f"{path}: no plot has the suffix {suffix!r}; use for example .png, .svg or .pdf")
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise InvalidCommand(f"{path}: there is no folder {folder}")


def plot(report: BenchReport, path: str) -> None:
    """Draw the histogram and the latency over time into a file, of the kind that its suffix names (.png, .svg).

    A report that was read from JSON has only the counts of its histogram: its bars are of all classes, and no panel
    shows values over time. Raises InvalidCommand without matplotlib, for an unknown suffix and for a folder that does
    not exist; OSError if it cannot be written.
    """
    check_plot(path)
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout="constrained")
    classes: dict[str, list[tuple[float, float]]] = {}
    for moment, latency, name in report.samples:
        classes.setdefault(name, []).append((moment, latency * 1000))
    panels = figure.subplots(1, 2 if classes else 1, squeeze=False)[0]
    if report.histogram:
        _histogram(panels[0], report, classes)
    if classes:
        _course(panels[1], classes)
    figure.suptitle(_title(report))
    figure.savefig(path)


def _title(report: BenchReport) -> str:
    line, nodes = report.line, len(report.nodes)
    return (
        f"{line['protocol']}, {nodes} node{'' if nodes == 1 else 's'}, {line['baudrate']} baud {line['framing']}: "
        f"{report.rate:.1f} values a second, {report.share:.1%} of the wire's limit"
    )


def _histogram(panel: Any, report: BenchReport, classes: dict[str, list[tuple[float, float]]]) -> None:
    """Draw the buckets of the report, with the classes stacked, and lines at some percentiles."""
    ratio = report.histogram[-1][0] / report.histogram[-2][0] if len(report.histogram) > 1 else 1.1
    edges = [1000 * report.histogram[0][0] / ratio, *(1000 * edge for edge, _ in report.histogram)]
    if classes:
        panel.hist([[ms for _, ms in dots] for dots in classes.values()], bins=edges, stacked=True, label=list(classes))
    else:
        panel.hist(edges[:-1], bins=edges, weights=[values for _, values in report.histogram])
    for name, style in zip(MARKED, (":", "--", "-"), strict=True):
        value = report.total.figures[name]
        panel.axvline(
            1000 * value, color="black", linewidth=0.8, linestyle=style, label=f"{name} {milliseconds(value)}"
        )
    panel.set(xscale="log", xlabel="latency, milliseconds", ylabel="values", title="Distribution")
    _plain_ticks(panel.xaxis)
    panel.legend(fontsize="small")


def _course(panel: Any, classes: dict[str, list[tuple[float, float]]]) -> None:
    """Draw a dot for each value, at the time when it came."""
    for name, dots in classes.items():
        shown = dots[:: 1 + len(dots) // MOST_DOTS]
        panel.plot([at for at, _ in shown], [ms for _, ms in shown], ".", markersize=2, label=name)
    panel.set(yscale="log", xlabel="seconds since the beginning", ylabel="latency, milliseconds", title="Over time")
    _plain_ticks(panel.yaxis)
    panel.legend(fontsize="small", markerscale=5)


def _plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers at 1, 2 and 5: a range of one decade has more than one label."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


__all__ = ["check_plot", "plot"]
