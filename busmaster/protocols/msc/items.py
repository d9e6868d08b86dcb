"""The items of an MSC, as the document (IB-11A002) describes them."""

from __future__ import annotations

from busmaster.contract.items import Item
from busmaster.protocols.msc.status import STATUS_BITS

ITEMS = (
    Item(
        "0-65535",
        "0-65535",
        "a 32-bit value of the program, -2147483648 to 2147483647; see the data table of its listing",
        access="read/write",
        keyword="DREAD, DWRITE",
    ),
    Item(
        "flag:0-255",
        "0-255",
        "1 or 0: inputs, outputs, timers, motor status and user flags; outputs and user flags may be written",
        access="read/write",
        keyword="RFLAG, SFLAG, CFLAG",
    ),
    Item("flags", "", "the flags that are on; one exchange for MSC-850/32, MSC-250", access="read", keyword="RFLAGS"),
    Item("status", "", "the program's status word", access="read", keyword="RQSTAT", bits=STATUS_BITS),
)


def width_of(item: str) -> int:
    """Return the number of bits of an item; of `flags`, all of them; 0 for a run."""
    name, colon, _ = item.partition(":")
    if colon:
        return 1 if name == "flag" else 0
    return {"flags": 256, "status": 16}.get(item, 32)
