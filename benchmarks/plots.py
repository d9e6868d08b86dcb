"""The figures, drawn: what `--plots DIR` writes. Needs matplotlib."""

from __future__ import annotations

from pathlib import Path

from benchmarks.harness import Outcome


def draw(outcomes: dict[str, Outcome], directory: Path) -> None:
    directory.mkdir(parents=True, exist_ok=True)
