"""Checks that an exchange declares the beginnings of its good replies correctly. R15 depends on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from busmaster.contract.exchange import Exchange


def check_good_reply(exchange: Exchange[Any], turns: Sequence[Sequence[bytes]]) -> Iterator[str]:
    """Yield the faults of a fresh exchange whose good reply is the steps of these turns.

    A turn is the steps that the node sends without a byte of the host in between. The last step decides. It begins with
    one of `answers`, or is equal to it if that is one byte. Each of `answers` occurs. All of the first turn is
    `overdue`.
    """
    steps = [step for turn in turns for step in turn]
    answers = tuple(exchange.answers)
    if steps and not _begins(steps[-1], answers):
        yield f"the good reply {steps[-1].hex(' ')} does not begin with one of its `answers` {_hex(answers)}"
    for key in answers:
        if not any(_begins(step, (key,)) for step in steps):
            yield f"no step of its good reply begins with {key.hex(' ')} of its `answers`"
    for step in turns[0] if turns else ():
        if not _begins(step, exchange.overdue):
            yield f"before the first byte, {step.hex(' ')} can arrive and is not in `overdue`: {_hex(exchange.overdue)}"


def check_exchangeable(asked: Exchange[Any], other: Exchange[Any]) -> str:
    """Return the fault if `asked` accepts the reply to `other`, but they have no common key; else ''."""
    may_come = {*other.answers, *other.overdue}
    if may_come & set(asked.answers):
        return ""
    what = f"has the `answers` {_hex(asked.answers)}, none of them a key of the other command: {_hex(sorted(may_come))}"
    if any(one.startswith(key) or key.startswith(one) for one in may_come for key in asked.answers):
        what += " (a key that only begins like another differs from it: use the same for both)"
    return what


def _begins(step: bytes, keys: Sequence[bytes]) -> bool:
    return any(step == key if len(key) == 1 else step.startswith(key) for key in keys)


def _hex(keys: Sequence[bytes]) -> str:
    return ", ".join(key.hex(" ") for key in keys) or "(none)"
