"""What a bench has measured: percentiles of latency, budgets for them, and the comparison of two reports."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from math import ceil, floor, isfinite, log10
from typing import Any

from busmaster.contract.arguments import meant
from busmaster.errors import InvalidCommand

LAYOUT = 1
"""Of the JSON. A report of another layout is not read."""
QUANTILES = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999}
FIGURES = (*QUANTILES, "max")
"""The figures of a distribution, as budgets, tables and JSON name them."""
COUNTS = ("errors", "missed")
"""The counts of a report that a budget can limit."""
CYCLE = "cycle"
"""Names the cycles of the poll group in a budget."""
PER_DECADE = (20, 10, 5, 2, 1)
"""How many buckets a decade of the histogram has: the most that give no more than MOST_ROWS rows."""
MOST_ROWS = 20
BUDGET = re.compile(r"(?:(.+)\.)?(p50|p90|p99\.9|p99|max|errors|missed)=(\d+(?:\.\d*)?|\.\d+)(ms|x)?")


@dataclass(frozen=True, slots=True)
class Times:
    """A distribution of times, in seconds. Each percentile is one of the times that were measured (nearest rank)."""

    count: int = 0
    mean: float = 0.0
    figures: Mapping[str, float] = field(default_factory=dict)
    """The percentiles, by the names of FIGURES; empty if nothing was measured."""

    @classmethod
    def of(cls, seconds: Iterable[float]) -> Times:
        """Return the distribution of these times."""
        ordered = sorted(seconds)
        count = len(ordered)
        if not count:
            return cls()
        figures = {name: ordered[ceil(share * count) - 1] for name, share in QUANTILES.items()}
        return cls(count, sum(ordered) / count, {**figures, "max": ordered[-1]})

    def fields(self) -> dict[str, Any]:
        """Return the distribution for JSON."""
        return {"count": self.count, "mean": self.mean, **self.figures}

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> Times:
        """Return the distribution that JSON holds. Raises KeyError, TypeError or ValueError for anything else."""
        count = int(fields["count"])
        return cls(count, float(fields["mean"]), {name: float(fields[name]) for name in FIGURES if count})


@dataclass(frozen=True, slots=True)
class Budget:
    """A limit for one figure of a report.

    `scope` is a node's address, a priority, the name of an application's call, or "cycle" for the cycles of the poll
    group; "" is the total. `limit` is in seconds, or a number of errors or missed cycles; if `relative`, it is a
    multiple of the same figure in the report that is compared with.
    """

    scope: str
    figure: str
    limit: float
    relative: bool = False

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Parse `p99=20` (milliseconds), `urgent.p99=20`, `5.max=50`, `errors=0` or `p99=1.2x`.

        Raises InvalidCommand.
        """
        found = BUDGET.fullmatch(text.strip())
        if found is None:
            raise InvalidCommand(
                f"a budget is written like p99=20, urgent.max=15, 5.p99.9=40, cycle.p99=90, errors=0, missed=0, or "
                f"p99=1.2x to compare, in milliseconds, with one of {' '.join((*FIGURES, *COUNTS))}; not {text!r}"
            )
        scope, figure, number, unit = found.groups()
        relative = unit == "x"
        if figure in COUNTS and (scope or unit):
            raise InvalidCommand(f"{figure} is a count of the whole run: write {figure}={number}, not {text}")
        limit = float(number)
        return cls(scope or "", figure, limit if relative or figure in COUNTS else limit / 1000, relative)

    def __str__(self) -> str:
        """Return the budget in words: "p99 of urgent"."""
        return self.figure + (f" of {self.scope}" if self.scope else "")


class BudgetExceeded(AssertionError):
    """A report exceeds a budget. A test that lets it pass fails with a message that names figure, value and budget."""


@dataclass(frozen=True, slots=True)
class BenchReport:
    """The results for one line. All times are in seconds.

    A latency is the time from the due time or the call of a read until its caller has the value. Failed reads are only
    in `errors`.
    """

    line: Mapping[str, Any]
    """Protocol, port, baud rate and framing."""
    workload: Mapping[str, Any]
    """The load on the line: see `Workload`."""
    elapsed: float
    values: int
    """Exchanges that brought a value to a caller or to the poll group."""
    limit: float
    """Values a second that the bits on the wire and the reply delay alone allow; 0 if no value came."""
    share: float
    """The share of the wire's limit that was reached."""
    total: Times
    nodes: Mapping[str, Times]
    priorities: Mapping[str, Times]
    calls: Mapping[str, Times]
    """The calls that the application timed, by name."""
    cycles: Times
    """From when a cycle of the poll group was due to when its consumer has the snapshot."""
    missed: int
    """Cycles of the poll group and of callers with a period that could not start in time."""
    errors: Mapping[str, int]
    """Failed reads and calls, by the class of the error."""
    histogram: tuple[tuple[float, int], ...]
    """The upper edge of each bucket, and the number of latencies in it."""
    samples: tuple[tuple[float, float, str], ...] = field(default=(), compare=False, repr=False)
    """When each value came, counted from the beginning, its latency, and its priority or call. Not in the JSON."""

    @property
    def rate(self) -> float:
        """Return how many values came a second."""
        return self.values / self.elapsed if self.elapsed > 0 else 0.0

    def scopes(self) -> dict[str, Times]:
        """Return all distributions, by the names that a budget has for them; "" is the total."""
        return {"": self.total, CYCLE: self.cycles, **self.calls, **self.priorities, **self.nodes}

    def exceeded(self, budgets: Iterable[Budget | str], *, before: BenchReport | None = None) -> list[str]:
        """Return a sentence for each budget that is exceeded. `before` is what a relative budget compares with.

        A figure of which nothing was measured exceeds its budget. Raises InvalidCommand for a budget that names
        nothing in this report.
        """
        parsed = [Budget.parse(budget) if isinstance(budget, str) else budget for budget in budgets]
        for budget in parsed:
            check_scope(budget, self.scopes())
        return [text for budget in parsed for text in self._excess(budget, before)]

    def check(self, *budgets: Budget | str, before: BenchReport | None = None) -> None:
        """Raise BudgetExceeded, with the measured figure, if one is exceeded: `report.check("p99=20", "errors=0")`."""
        texts = self.exceeded(budgets, before=before)
        if texts:
            raise BudgetExceeded("; ".join(texts))

    def _excess(self, budget: Budget, before: BenchReport | None) -> Iterator[str]:
        found = self.figure(budget)
        if budget.relative and before is None:
            raise InvalidCommand(f"{budget}: a multiple needs a report to compare with; write milliseconds")
        base = before.figure(budget) if budget.relative and before is not None else None
        limit = budget.limit if base is None else base * budget.limit
        if found is None:
            yield f"{budget}: nothing was measured"
        elif budget.relative and base is None:
            yield f"{budget}: nothing was measured in the first report"
        elif found > limit:
            if budget.figure in COUNTS:
                yield f"{found:g} {budget}, budget {limit:g}"
            else:
                of = f" ({budget.limit:g} times {milliseconds(base)})" if base is not None else ""
                yield f"{budget}: {milliseconds(found)}, budget {milliseconds(limit)}{of}"

    def figure(self, budget: Budget) -> float | None:
        """Return the figure that a budget limits; None if nothing was measured."""
        if budget.figure in COUNTS:
            return float(self.missed if budget.figure == "missed" else sum(self.errors.values()))
        return self.scopes().get(budget.scope, Times()).figures.get(budget.figure)

    def fields(self) -> dict[str, Any]:
        """Return the report for JSON. The same measurement gives the same text."""
        return {
            "layout": LAYOUT,
            "line": dict(self.line),
            "workload": dict(self.workload),
            "elapsed": self.elapsed,
            "values": self.values,
            "rate": self.rate,
            "limit": self.limit,
            "share": self.share,
            "missed": self.missed,
            "errors": dict(self.errors),
            "total": self.total.fields(),
            "cycles": self.cycles.fields(),
            "nodes": {name: times.fields() for name, times in self.nodes.items()},
            "priorities": {name: times.fields() for name, times in self.priorities.items()},
            "calls": {name: times.fields() for name, times in self.calls.items()},
            "histogram": [list(bucket) for bucket in self.histogram],
        }

    def to_json(self) -> str:
        """Return the report as one line of JSON, which `from_json` and `busmaster bench --compare` read."""
        return json.dumps(self.fields(), ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str | bytes) -> BenchReport:
        """Return the report in a JSON text. Raises InvalidCommand for a text that is not a report."""
        try:
            fields = json.loads(text)
            if fields["layout"] != LAYOUT:
                raise InvalidCommand(f"it is a report of layout {fields['layout']}, not {LAYOUT}: measure again")
            groups = ({n: Times.from_fields(of) for n, of in fields[key].items()} for key in GROUPS)
            nodes, priorities, calls = groups
            return cls(
                line=dict(fields["line"]),
                workload=dict(fields["workload"]),
                elapsed=float(fields["elapsed"]),
                values=int(fields["values"]),
                limit=float(fields["limit"]),
                share=float(fields["share"]),
                total=Times.from_fields(fields["total"]),
                nodes=nodes,
                priorities=priorities,
                calls=calls,
                cycles=Times.from_fields(fields["cycles"]),
                missed=int(fields["missed"]),
                errors={str(name): int(count) for name, count in fields["errors"].items()},
                histogram=tuple((float(edge), int(count)) for edge, count in fields["histogram"]),
            )
        except InvalidCommand:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidCommand(f"it is not a report of `busmaster bench --json` ({error!r})") from None


GROUPS = ("nodes", "priorities", "calls")


def check_scope(budget: Budget, known: Iterable[str]) -> None:
    """Raise InvalidCommand unless a budget names the total or one of `known`."""
    names = [name for name in known if name]
    if budget.scope and budget.scope not in names:
        raise InvalidCommand(
            f"budget {budget}: nothing measured has the name {budget.scope!r}; {meant(budget.scope, names)}"
        )


def histogram(latencies: Iterable[float]) -> tuple[tuple[float, int], ...]:
    """Sort times into buckets of equal width on a logarithmic scale, at most MOST_ROWS of them, gaps included."""
    positive = [max(latency, 1e-9) for latency in latencies]
    if not positive:
        return ()
    lowest, highest = log10(min(positive)), log10(max(positive))
    for per_decade in PER_DECADE:
        first, last = floor(lowest * per_decade), floor(highest * per_decade)
        if last - first < MOST_ROWS:
            break
    counts = [0] * (last - first + 1)
    for latency in positive:
        counts[floor(log10(latency) * per_decade) - first] += 1
    return tuple((10 ** ((first + place + 1) / per_decade), count) for place, count in enumerate(counts))


def ratios(before: BenchReport, after: BenchReport) -> dict[str, dict[str, float]]:
    """Return, of all distributions that both reports have, each figure of the second in terms of the first."""
    others = after.scopes()
    return {
        name: {figure: others[name].figures[figure] / value for figure, value in times.figures.items() if value > 0}
        for name, times in before.scopes().items()
        if times.count and name in others and others[name].count
    }


def milliseconds(seconds: float) -> str:
    """Return a time in milliseconds, to four digits."""
    number = seconds * 1000
    return f"{number:.4g} ms" if isfinite(number) and number < 9999.5 else f"{number:.0f} ms"


__all__ = [
    "CYCLE",
    "FIGURES",
    "BenchReport",
    "Budget",
    "BudgetExceeded",
    "Times",
    "check_scope",
    "histogram",
    "milliseconds",
    "ratios",
]
