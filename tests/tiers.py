"""Parametrisations of which a part runs by default and the rest with `-m slow`: what each shows is shown in both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def one_by_default(values: Iterable[Any], others: pytest.MarkDecorator = pytest.mark.slow) -> list[Any]:
    """Return parameters of which the first runs by default; the others are slow, or have another mark."""
    first, *rest = values
    return [first, *(pytest.param(value, marks=others) for value in rest)]


def one_slow(values: Iterable[Any], others: pytest.MarkDecorator) -> list[Any]:
    """Return parameters of which the first is slow and the others have this mark."""
    first, *rest = values
    return [pytest.param(first, marks=pytest.mark.slow), *(pytest.param(value, marks=others) for value in rest)]


def in_turn_by_default(firsts: Iterable[Any], seconds: Iterable[Any]) -> list[Any]:
    """Return all pairs as parameters. By default each of the seconds runs once, with the next of the firsts in turn;
    the other pairs are slow."""
    turns: Sequence[Any] = list(firsts)
    return [
        pytest.param(first, second, marks=[] if number % len(turns) == turn else [pytest.mark.slow])
        for number, second in enumerate(seconds)
        for turn, first in enumerate(turns)
    ]
