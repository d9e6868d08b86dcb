"""The common part of HCP and HCP2: numbered elements of a comms array, and the controllers that have one."""

from __future__ import annotations

from busmaster.registry import Option

EMULATED = (
    Option(
        "program",
        "text",
        choices=("winding", "command_handshake", "report_positions"),
        about="The program that it runs, one of those in the documents; where it is lively, by default "
        "one that reports the positions of its axes, which swing.",
    ),
    Option("jogs_on_comms1", "flag", about="An event on element 1 jogs axis 0 at the value written."),
    Option("axes", "whole", about="How many axes it has, 1 to 8; 8 by default. The elements of others are reserved."),
    Option(
        "statement",
        "positive",
        about="How many seconds a statement of its program takes; 0.001 by default, 0.05 where it is "
        "lively and has no `program`.",
    ),
    Option("firmware", "whole", about="Its firmware's build; 5628 by default."),
    Option("fixed_decimals", "flag", about="It sends four decimals, 12.5000 in place of 12.5."),
    Option("all_or_nothing", "flag", about="A write of several values that it refuses has stored none of them."),
    Option("refuse_reserved", "flag", about="It refuses to read elements that are reserved; else they read 0."),
    Option("single_precision", "flag", about="It keeps values with 24 bits, as a real one does."),
)
"""Options of an emulated controller."""
