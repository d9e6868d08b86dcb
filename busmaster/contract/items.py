"""Items of a protocol as data, from its document. Used for lists, help and handles."""

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
    """One bit of a word, 0 the lowest. `severity`: whether it reports a problem while it is set."""

    number: int
    name: str
    meaning: str
    severity: Severity = ""


@dataclass(frozen=True, slots=True)
class Item:
    """One item, as described in the document.

    `item`: its name as an ITEM; 1-99 stands for each of them, as in LINE.toml. `number`: its number in the document.
    `keyword`: its name in the device's own language. `access`: empty if the document does not state it. `decimals`:
    number of digits on the line that are decimals of its unit.
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
    """Return the bits of a word with their meaning. `errors` and `warnings`: the bits that report problems."""

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
