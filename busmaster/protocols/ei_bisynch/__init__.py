"""EI-Bisynch ASCII, of Eurotherm instruments and Parker SSD drives."""

from __future__ import annotations

from busmaster.protocols.ei_bisynch.capture import BisynchDialect
from busmaster.protocols.ei_bisynch.codec import PROFILE, Read, ReadRun, Write
from busmaster.protocols.ei_bisynch.handle import BisynchInstrument
from busmaster.protocols.ei_bisynch.parameters import ITEMS, NAMED
from busmaster.protocols.mentor import CHAIN
from busmaster.registry import NodeKind, Option, Protocol, device_of

PRINTABLE_CHECK = Option(
    "printable_check", "flag", about="32 is added to a checksum (BCC) below 32, as some manuals have it."
)
FIXED_WIDTH = Option(
    "fixed_width",
    "whole",
    about="Number of characters to which a number is filled with zeros (fixed format); by default free format.",
)

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "ei-bisynch",
            BisynchInstrument,
            device_of("busmaster.protocols.ei_bisynch.device"),
            items="PV (a mnemonic), 1PV (of channel 1), tag247 (by its tag), SW:hex (written in hexadecimal), PV,SL,OP "
            f"(a run), or a name: {' '.join(NAMED)}",
            probe_item="II",
            documented=ITEMS,
            options=(FIXED_WIDTH, PRINTABLE_CHECK),
            read_options=(CHAIN,),
            whole_numbers=lambda item: item.endswith(":hex"),
            width=lambda item: 0 if "," in item else 16,
            takes_decimals=True,
            emulated=(
                FIXED_WIDTH,
                PRINTABLE_CHECK,
                Option(
                    "lag",
                    "positive",
                    about="Time constant with which the process value follows the setpoint, in seconds; 60 by default.",
                ),
                Option(
                    "parameters",
                    "tables",
                    about="Further parameters by mnemonic or tag, or replacements of existing ones: "
                    "`parameters = { SW = { hexadecimal = true }, tag247 = { low = -100, high = 100 } }`.",
                    fields=(
                        Option("low", "number", about="Lower limit; -99999 by default."),
                        Option("high", "number", about="Upper limit; 99999 by default."),
                        Option("read_only", "flag", about="Writes to it are refused."),
                        Option("write_only", "flag", about="Reads of it are refused."),
                        Option("hexadecimal", "flag", about="It is a word of 16 bits, sent as hexadecimal digits."),
                    ),
                ),
            ),
        ),
    ),
    commands={"read": Read, "read_run": ReadRun, "write": Write},
    dialect=BisynchDialect,
)

__all__ = [
    "PROTOCOL",
    "BisynchInstrument",
]
