"""Mentor II (ANSI x3.28-2.5-A4)."""

from __future__ import annotations

from busmaster.contract.arguments import is_decimal
from busmaster.protocols.mentor.capture import MentorDialect
from busmaster.protocols.mentor.codec import PROFILE, Read, ReadRun, Write
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.protocols.mentor.parameters import ITEMS, NAMED
from busmaster.registry import NodeKind, Option, Protocol, device_of, everywhere

CHAIN = Option("chain", "flag", "read a run in one exchange; use it only if no other drive can misinterpret it")

EMULATED = (
    Option(
        "acceleration", "positive", about="How fast its speed follows the reference, in 0.1 % a second; 500 by default."
    ),
    Option(
        "ripple",
        "share",
        about="Share, 0 to 1, by which the measured speed varies with the shaft; 0.01 by default, 0 if the drive is "
        "not lively.",
    ),
    Option("short_after_write", "flag", about="Short commands work after a write too."),
    Option("refuse_malformed", "flag", about="The reply to a malformed read request is a NAK, not silence."),
    Option(
        "parameters",
        "tables",
        about='Further parameters, or other limits, by number: `parameters = { "7.05" = { low = 0, high = 999 } }`.',
        fields=(
            Option(
                "low",
                "number",
                about="Lower limit, without decimals; by default that of its form.",
            ),
            Option(
                "high",
                "number",
                about="Upper limit, without decimals; by default that of its form.",
            ),
            Option("read_only", "flag", about="Writes to it are refused."),
            Option("wide", "flag", about="It has five digits and no sign, as `:wide` reads it."),
            Option("fine", "flag", about="It has one digit more, as `:hires` reads it."),
        ),
    ),
)
"""Options of an emulated drive. `fine`: it may be written in high resolution."""

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "mentor",
            MentorDrive,
            device_of("busmaster.protocols.mentor.device"),
            items="1.17 (menu and parameter), 15.60:wide, 1.17:hires, 1.17:20 (20 parameters from there on), or a "
            f"name: {' '.join(NAMED)}",
            probe_item="1.17",
            documented=ITEMS,
            options=(
                Option(
                    "chained",
                    "flag",
                    about="Poll groups read neighbouring parameters in one exchange, as a run. Use it only if no other "
                    "drive on the line can misinterpret it.",
                ),
            ),
            read_options=(CHAIN,),
            whole_numbers=everywhere,
            width=lambda item: 0 if is_decimal(item.partition(":")[2]) else 16,
            takes_decimals=True,
            emulated=EMULATED,
            capture_id=5,
        ),
    ),
    commands={"read": Read, "read_run": ReadRun, "write": Write},
    dialect=MentorDialect,
)
