"""The common part of HCP and HCP2: numbered elements of a comms array, and the controllers that have one."""

from __future__ import annotations

from busmaster.registry import Option

EMULATED = (
    Option(
        "program",
        "text",
        choices=("winding", "command_handshake", "report_positions"),
        about="The program that it runs, one of those in the documents. A lively controller by default runs one "
        "that reports the positions of its moving axes.",
    ),
    Option("jogs_on_comms1", "flag", about="A write to element 1 jogs axis 0 at the written value, by an event."),
    Option("axes", "whole", about="How many axes it has, 1 to 8; 8 by default. The elements of others are reserved."),
    Option(
        "statement",
        "positive",
        about="Seconds that a statement of its program takes; 0.001 by default, 0.05 if it is lively and has no "
        "`program`.",
    ),
    Option("firmware", "whole", about="Its firmware's build; 5628 by default."),
    Option("fixed_decimals", "flag", about="It sends four decimals, 12.5000 instead of 12.5."),
    Option("all_or_nothing", "flag", about="If it refuses a write of several values, it stores none of them."),
    Option("refuse_reserved", "flag", about="It refuses to read elements that are reserved; else they read 0."),
    Option("single_precision", "flag", about="It stores values with 24 bits, like a real controller."),
)
"""Options of an emulated controller."""
