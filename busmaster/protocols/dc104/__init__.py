"""DC104-SER drives, one to a line."""

from __future__ import annotations

from busmaster.contract.items import Item
from busmaster.protocols.dc104.capture import Dc104Dialect
from busmaster.protocols.dc104.codec import PROFILE, Read, Write
from busmaster.protocols.dc104.handle import Dc104Drive
from busmaster.registry import NodeKind, Option, Protocol, device_of, everywhere

MAXIMUM = Option("maximum", "whole", about="The number of its last parameter, 1 to 255; 255 by default.")
ALLOW_ZERO = Option("allow_zero", "flag", about="It has a parameter 0 too.")

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "dc104",
            Dc104Drive,
            device_of("busmaster.protocols.dc104.device"),
            items="a parameter, 1 to 255",
            probe_item="1",
            documented=(Item("1-255", "1-255", "a parameter, 0 to 65535", access="read/write"),),
            options=(MAXIMUM, ALLOW_ZERO),
            emulated=(
                MAXIMUM,
                ALLOW_ZERO,
                Option("read_only", "numbers", about="The parameters that refuse writes."),
                Option("eeprom", "delay", about="How long storing a value takes; 0.01 by default."),
                Option("silent", "flag", about="A read of a missing parameter has no reply, instead of a NAK."),
            ),
            whole_numbers=everywhere,
            width=lambda item: 16,
            capture_id=6,
        ),
    ),
    commands={"read": Read, "write": Write},
    dialect=Dc104Dialect,
)
