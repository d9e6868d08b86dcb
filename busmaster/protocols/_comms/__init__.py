"""What HCP and HCP2 share: numbered elements of a comms array, and the controllers that have one."""

from __future__ import annotations

from busmaster.registry import Option

EMULATED = (
    Option("program", "text", choices=("winding", "command_handshake", "report_positions")),
    Option("jogs_on_comms1", "flag"),
    Option("axes", "whole"),
    Option("statement", "positive"),
    Option("firmware", "whole"),
    Option("fixed_decimals", "flag"),
    Option("all_or_nothing", "flag"),
    Option("refuse_reserved", "flag"),
    Option("single_precision", "flag"),
)
"""What can be said of an emulated controller."""
