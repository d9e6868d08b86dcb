"""Many worlds explored, side by side, and what was found of them kept."""

from __future__ import annotations

import ast
import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from tests.verification.proof.explore import Explorer, Found
from tests.verification.proof.history import as_test, retell, told
from tests.verification.proof.setups import Setup

ROOT = Path(__file__).parents[3]
EXPLORED = (
    *("busmaster/arbiter", "busmaster/contract", "busmaster/wire", "busmaster/protocols"),
    "tests/verification/proof",
)


class _Words(ast.NodeTransformer):
    """Takes docstrings out."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        return None if isinstance(node.value, ast.Constant) else node


def fingerprint() -> str:
    """Return what changes with the code that is explored, or that explores; not with what is said of it.

    Raises FileNotFoundError for a folder without code: then the fingerprint would not change with what moved away.
    """
    digest = hashlib.sha256()
    for folder in EXPLORED:
        paths = sorted((ROOT / folder).rglob("*.py"))
        if not paths:
            raise FileNotFoundError(f"there is no code in {folder}: say in EXPLORED where it is now")
        for path in paths:
            if path.name not in ("worlds.py", "runs.py", "__main__.py") and not path.name.startswith("test_"):
                digest.update(ast.dump(_Words().visit(ast.parse(path.read_bytes()))).encode())
    return digest.hexdigest()[:16]


def explore(setup: Setup, limit: float) -> dict[str, Any]:
    """Explore one world; return what is written of it."""
    found = Explorer(setup).run(limit)
    return {
        "world": setup.name,
        "keys": found.keys,
        "zones": found.zones,
        "events": found.events,
        "seconds": round(found.seconds, 1),
        "closed": found.closed,
        "left": found.left,
        "violations": [_violation(setup, found, problem) for problem in found.violations],
    }


def _violation(setup: Setup, found: Found, problem: str) -> dict[str, Any]:
    histories = found.violations[problem]
    calls = retell(setup, histories, problem)
    if calls is None:
        return {"problem": problem, "history": f"not possible as it was found: {histories[0]}", "test": ""}
    return {"problem": problem, "history": told(calls), "test": as_test(setup, calls, problem)}


def line_of(result: dict[str, Any]) -> str:
    end = "closed" if result["closed"] else f"open, {result['left']} left"
    broken = "".join(f"\n    VIOLATION {v['problem']}" for v in result["violations"])
    numbers = (
        f"{result['keys']:7} keys {result['zones']:7} zones {result['events']:8} events {result['seconds']:7.1f} s"
    )
    return f"{numbers}  {end:18} {result['world']}{broken}"


def table(results: Iterable[dict[str, Any]]) -> Iterator[str]:
    """The lines of the table that the documentation shows."""
    yield "| world | keys | zones | events | seconds | closed | violations |"
    yield "|---|---:|---:|---:|---:|---|---|"
    for result in results:
        closed = "yes" if result["closed"] else f"no, {result['left']} left"
        broken = "; ".join(v["problem"] for v in result["violations"]) or "none"
        numbers = " | ".join(f"{result[name]}" for name in ("keys", "zones", "events", "seconds"))
        yield f"| {result['world']} | {numbers} | {closed} | {broken} |"


def known(path: Path, code: str) -> dict[str, dict[str, Any]]:
    """What earlier runs have found of this very code, each world as far as it was ever explored."""
    if not path.exists():
        return {}
    results = [json.loads(line) for line in path.read_text().splitlines()]
    results.sort(key=lambda result: (result["closed"], result["events"]))
    return {result["world"]: result for result in results if result["code"] == code}


def is_done(result: dict[str, Any] | None, each: float) -> bool:
    """Whether no more would be found of a world in so many seconds."""
    return result is not None and bool(result["closed"] or result["violations"] or result["seconds"] >= each)


def to_explore(setups: Sequence[Setup], before: Mapping[str, dict[str, Any]], each: float) -> list[Setup]:
    """Return the worlds of which more would be found; those first that were never begun."""
    wanted = [setup for setup in setups if not is_done(before.get(setup.name), each)]
    return sorted(wanted, key=lambda setup: setup.name in before)


def run(
    setups: Sequence[Setup], jobs: int, minutes: float, each: float, path: Path, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Explore what is not known yet, `jobs` at a time, for about so many minutes; tell and write each result. A world
    has `each` seconds of a core at the most, and is begun again where it had fewer before."""
    code = fingerprint()
    before = known(path, code)
    todo = to_explore(setups, before, each)
    say(f"{len(setups)} worlds, {len(setups) - len(todo)} of them known from before")
    count = len(setups) - len(todo)
    until = time.monotonic() + 60 * minutes
    with ProcessPoolExecutor(jobs, max_tasks_per_child=1) as pool, path.open("a") as file:
        running: set[Future[dict[str, Any]]] = set()
        while todo or running:
            while todo and len(running) < jobs and time.monotonic() < until:
                running.add(pool.submit(explore, todo.pop(0), min(each, until - time.monotonic())))
            if not running:
                break
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                bug = future.exception()
                if bug is not None:
                    say(f"a world was not explored: {bug!r}")
                    continue
                result = {"code": code, **future.result()}
                file.write(json.dumps(result) + "\n")
                file.flush()
                count += 1
                say(f"[{count:3}/{len(setups)}] {line_of(result)}")
    results = known(path, code)
    return [results[setup.name] for setup in setups if setup.name in results]
