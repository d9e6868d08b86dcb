"""Whether an exchange says rightly what its good replies begin with: on that rests what is believed (R15)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from busmaster.contract.exchange import Exchange


def check_good_reply(exchange: Exchange[Any], turns: Sequence[Sequence[bytes]]) -> Iterator[str]:
    """Say what does not hold of a fresh exchange whose good reply is the legs of these turns.

    A turn is what the node says without a word of the host between. What decides comes last, and begins with one of
    `answers`, or is it where that is one byte; each of `answers` is met with; all of the first turn is `owed`.
    """
    legs = [leg for turn in turns for leg in turn]
    answers = tuple(exchange.answers)
    if legs and not _begins(legs[-1], answers):
        yield f"the good reply {legs[-1].hex(' ')} begins with none of its answers {_hex(answers)}"
    for key in answers:
        if not any(_begins(leg, (key,)) for leg in legs):
            yield f"no leg of its good reply begins with its answer {key.hex(' ')}"
    for leg in turns[0] if turns else ():
        if not _begins(leg, exchange.owed):
            yield f"while nothing was heard yet, {leg.hex(' ')} may come and is not owed: {_hex(exchange.owed)}"


def check_exchangeable(asked: Exchange[Any], other: Exchange[Any]) -> str:
    """Say what does not hold where `asked` takes the reply to `other`: what that owes is an answer to this. Else ''."""
    may_come = {*other.answers, *other.owed}
    if may_come & set(asked.answers):
        return ""
    what = f"has the answers {_hex(asked.answers)}, and none that is owed by another: {_hex(sorted(may_come))}"
    if any(one.startswith(key) or key.startswith(one) for one in may_come for key in asked.answers):
        what += " (one that only begins like another is another: give both the same)"
    return what


def _begins(leg: bytes, keys: Sequence[bytes]) -> bool:
    return any(leg == key if len(key) == 1 else leg.startswith(key) for key in keys)


def _hex(keys: Sequence[bytes]) -> str:
    return ", ".join(key.hex(" ") for key in keys) or "(none)"
