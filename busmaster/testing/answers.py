"""Whether an exchange says rightly what its good replies begin with: on that rests what is believed (R15)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from busmaster.contract.exchange import Exchange


def check_good_reply(exchange: Exchange[Any], turns: Sequence[Sequence[bytes]]) -> Iterator[str]:
    """Say what does not hold of a fresh exchange whose good reply is the steps of these turns.

    A turn is what the node says without a word of the host between. What decides comes last, and begins with one of
    `answers`, or is it where that is one byte; each of `answers` is met with; all of the first turn is `overdue`.
    """
    steps = [step for turn in turns for step in turn]
    answers = tuple(exchange.answers)
    if steps and not _begins(steps[-1], answers):
        yield f"the good reply {steps[-1].hex(' ')} begins with none of its answers {_hex(answers)}"
    for key in answers:
        if not any(_begins(step, (key,)) for step in steps):
            yield f"no step of its good reply begins with its answer {key.hex(' ')}"
    for step in turns[0] if turns else ():
        if not _begins(step, exchange.overdue):
            yield f"while nothing was heard yet, {step.hex(' ')} may come and is not overdue: {_hex(exchange.overdue)}"


def check_exchangeable(asked: Exchange[Any], other: Exchange[Any]) -> str:
    """Say what does not hold where `asked` takes the reply to `other`: what that owes is an answer to this. Else ''."""
    may_come = {*other.answers, *other.overdue}
    if may_come & set(asked.answers):
        return ""
    what = f"has the answers {_hex(asked.answers)}, and none that is overdue by another: {_hex(sorted(may_come))}"
    if any(one.startswith(key) or key.startswith(one) for one in may_come for key in asked.answers):
        what += " (one that only begins like another is another: give both the same)"
    return what


def _begins(step: bytes, keys: Sequence[bytes]) -> bool:
    return any(step == key if len(key) == 1 else step.startswith(key) for key in keys)


def _hex(keys: Sequence[bytes]) -> str:
    return ", ".join(key.hex(" ") for key in keys) or "(none)"
