"""What a protocol's document says of each item, as data: lists, help and handles are made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Literal, TypeAlias, TypeVar

Access: TypeAlias = Literal["read", "write", "read/write", ""]
Severity: TypeAlias = Literal["", "warning", "error"]
Word = TypeVar("Word", bound=IntFlag)


@dataclass(frozen=True, slots=True)
class Bit:
    """Describe one bit of a word, 0 the lowest. `severity` says whether something is wrong while it is set."""

    number: int
    name: str
    meaning: str
    severity: Severity = ""


@dataclass(frozen=True, slots=True)
class Item:
    """Describe what a document says of one item.

    `item` is what is written where an ITEM is asked for; 1-99 stands for each of them, as in LINE.toml. `number` is
    what the document calls it by, `keyword` its name in the device's own language. `access` is empty where the
    document does not say it. `decimals`: how many of the last digits on the line are decimals of its unit.
    """

    item: str
    number: str
    meaning: str
    unit: str = ""
    access: Access = ""
    keyword: str = ""
    bits: tuple[Bit, ...] = ()
    decimals: int = 0


def bits_of(
    meanings: Mapping[Word, str], *, errors: IntFlag | None = None, warnings: IntFlag | None = None
) -> tuple[Bit, ...]:
    """Describe the bits of a word, by what each means; `errors` and `warnings` are those that tell of trouble."""

    def severity(flag: Word) -> Severity:
        if errors is not None and flag & errors:
            return "error"
        return "warning" if warnings is not None and flag & warnings else ""

    return tuple(
        Bit(flag.bit_length() - 1, str(flag.name), meaning, severity(flag)) for flag, meaning in meanings.items()
    )


__all__ = [
    "Access",
    "Bit",
    "Item",
    "Severity",
    "bits_of",
]
