"""`python -m benchmarks [SCENARIO...] [--quick] [--json FILE] [--plots DIR]`."""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.harness import Options, Outcome, machine

SCENARIOS = (
    "turnaround",
    "utilisation",
    "dead_node",
    "late_replies",
    "lossy_line",
    "cancellation",
    "urgent",
    "jitter",
    "many_lines",
    "codecs",
    "simulation",
    "peers",
    "loop_stalls",
    "gone_port",
    "service",
)


def main() -> int:
    """Exit status 1 if one of our values was wrong. A figure that misses its claim is said, and fails nothing."""
    arguments = _parse()
    logging.disable(logging.CRITICAL)
    where = machine()
    versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    print(f"{where['processor']}, {where['cores']} cores, load {where['load']:.1f}, {where['system']}")
    print(f"{where['python']}; {versions}")
    outcomes: dict[str, Outcome] = {}
    figures: dict[str, Any] = {"machine": where, "quick": arguments.quick, "scenarios": {}}
    for name in arguments.scenarios:
        begun = time.perf_counter()
        scenario = importlib.import_module(f"benchmarks.{name}")
        print(f"\n=== {name}: {(scenario.__doc__ or '').splitlines()[0]}", flush=True)
        outcome: Outcome = scenario.run(Options(quick=arguments.quick))
        outcomes[name] = outcome
        figures["scenarios"][name] = outcome.as_json()
        for table in outcome.tables:
            print(f"\n{table.text()}")
        for claim in outcome.claims:
            print(claim)
        print(f"({time.perf_counter() - begun:.1f} s)", flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1))
    if arguments.plots is not None:
        from benchmarks.plots import draw

        print(*draw(outcomes, arguments.plots), sep="\n")
    wrong = {name: outcome.wrong for name, outcome in outcomes.items() if outcome.wrong}
    if wrong:
        print(f"WRONG VALUES: {wrong}", file=sys.stderr)
    return 1 if wrong else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"of {' '.join(SCENARIOS)}; all by default")
    parser.add_argument("--quick", action="store_true", help="as few repetitions as still exercise everything")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw them (needs matplotlib)")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.scenarios if name not in SCENARIOS]
    if unknown:
        parser.error(f"no such scenario: {' '.join(unknown)}; use {' '.join(SCENARIOS)}")
    arguments.scenarios = arguments.scenarios or list(SCENARIOS)
    return arguments


if __name__ == "__main__":
    sys.exit(main())
