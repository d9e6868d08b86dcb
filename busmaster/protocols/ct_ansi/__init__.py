"""CT-ANSI of Unidrive and Commander: Mentor II's frames, numbers with a decimal point."""

from __future__ import annotations

from busmaster.contract.arguments import is_decimal
from busmaster.protocols.ct_ansi.capture import CtAnsiDialect
from busmaster.protocols.ct_ansi.codec import PROFILE, Read, ReadRun, Write
from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
from busmaster.protocols.mentor import CHAIN, EMULATED
from busmaster.protocols.mentor.parameters import ANY
from busmaster.registry import NodeKind, Option, Protocol, device_of

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "ct-ansi",
            CtAnsiDrive,
            device_of("busmaster.protocols.ct_ansi.device"),
            items="1.21 (menu and parameter), 1.21:8 (8 parameters from there on)",
            probe_item="1.17",
            documented=(ANY,),
            read_options=(CHAIN,),
            width=lambda item: 0 if is_decimal(item.partition(":")[2]) else 32,
            takes_decimals=True,
            emulated=(
                *EMULATED,
                Option("plus", "flag", about="Values from 0 up are sent with a sign."),
                Option(
                    "width",
                    "whole",
                    about="Values are filled with zeros to this length; by default not.",
                ),
            ),
            capture_id=8,
        ),
    ),
    commands={"read": Read, "read_run": ReadRun, "write": Write},
    dialect=CtAnsiDialect,
)
