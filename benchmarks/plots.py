"""The figures, drawn: what `--plots DIR` writes, as SVG. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.harness import Outcome

SIZE = (8.0, 4.5)
LINE_COLOURS = {"host": "#1f6f8b", "line": "#e07a3f"}


def draw(outcomes: Mapping[str, Outcome], directory: Path) -> list[Path]:
    """One file a picture; returns them. Scenarios that were not run, or have nothing to draw, are left out."""
    directory.mkdir(parents=True, exist_ok=True)
    drawn = []
    for name, outcome in outcomes.items():
        picture = PICTURES.get(name)
        if picture is not None and outcome.series:
            drawn.append(directory / f"{name}.svg")
            picture(outcome.series, drawn[-1])
    return drawn


def _distributions(series: Mapping[str, Any], path: Path) -> None:
    """For each loop, the share of requests that left within so many microseconds of the reply before."""
    figure, axes = _figure(len(series))
    for panel, (title, masters) in zip(axes, series.items(), strict=True):
        for name, seconds in masters.items():
            _curve(panel, name, [1e6 * value for value in seconds])
        panel.set(xlabel="microseconds", ylabel="share", xscale="log", title=title)
        panel.legend(fontsize="x-small")
    _save(figure, path)


def _latencies(series: Mapping[str, Any], path: Path) -> None:
    """Of each master, with all units alive and with one dead: the share of its values that came within so long."""
    figure, axes = _figure(2)
    for panel, state in zip(axes, ("alive", "dead"), strict=True):
        for name, states in series.items():
            _curve(panel, name, [1e3 * value for value in states[state]])
        panel.set(xlabel="milliseconds", ylabel="share", xscale="log")
        panel.set_title("all units alive" if state == "alive" else "one unit dead")
        panel.legend(fontsize="x-small")
    _save(figure, path)


def _utilisation(series: Mapping[str, Any], path: Path) -> None:
    """Of the limit of the wire, in per cent: ours, and the bare loop beside it."""
    figure, (panel,) = _figure(1)
    places = range(len(series))
    for shift, name in ((-0.2, "ours"), (0.2, "bare")):
        shares = [figures[name] for figures in series.values()]
        panel.bar([place + shift for place in places], shares, width=0.4, label=name)
    panel.axhline(100, color="black", linewidth=0.8)
    panel.set_xticks(list(places), list(series), rotation=90, fontsize="x-small")
    panel.set(ylabel="% of the wire's limit", ylim=(0, 105))
    panel.legend()
    _save(figure, path)


def _timelines(series: Mapping[str, Any], path: Path) -> None:
    """Half a second of each master's line with one unit dead: what the host said, what the units said, and nothing."""
    figure, (panel,) = _figure(1)
    for row, of in enumerate(series.values()):
        log = of["timeline"]
        for who, colour in LINE_COLOURS.items():
            spans = [(1e3 * (start - log[0][0]), 1e3 * taken) for start, whose, _, taken in log if whose == who]
            panel.broken_barh(spans, (row - 0.35, 0.7), facecolors=colour, label=who if row == 0 else None)
    panel.set_yticks(range(len(series)), list(series))
    panel.invert_yaxis()
    panel.set(xlabel="milliseconds", title="the line with one of eight units dead")
    panel.legend(loc="lower right")
    _save(figure, path)


def _many_lines(series: Mapping[str, Any], path: Path) -> None:
    """Of so many lines in one process: the slowest one's share of its rate alone, and the CPU a transaction."""
    figure, (shares, costs) = _figure(2)
    shares.plot(list(series), [of["worst"] for of in series.values()], marker="o")
    shares.set(ylabel="slowest line, % of its rate alone", ylim=(0, 105))
    costs.plot(list(series), [1e6 * of["cpu"] for of in series.values()], marker="o")
    costs.set(ylabel="CPU a transaction, microseconds", ylim=(0, None))
    for panel in (shares, costs):
        panel.tick_params(axis="x", rotation=45)
    _save(figure, path)


PICTURES = {
    "turnaround": _distributions,
    "utilisation": _utilisation,
    "dead_node": _timelines,
    "urgent": _latencies,
    "jitter": _latencies,
    "many_lines": _many_lines,
}


def _figure(panels: int) -> tuple[Any, Iterable[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE[0] * (1.5 if panels > 1 else 1), SIZE[1]), layout="constrained")
    return figure, figure.subplots(1, panels, squeeze=False)[0]


def _curve(panel: Any, name: str, values: Iterable[float]) -> None:
    ordered = sorted(values)
    if ordered:
        panel.step(ordered, [(n + 1) / len(ordered) for n in range(len(ordered))], where="post", label=name)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path)
