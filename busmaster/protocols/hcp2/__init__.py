"""Host Comms Protocol 2 (AN00129): Mint controllers, and MicroFlex drives with a map of their own."""

from __future__ import annotations

from busmaster.protocols._comms import EMULATED
from busmaster.protocols.hcp2 import comms_array, microflex
from busmaster.protocols.hcp2.capture import Hcp2Dialect
from busmaster.protocols.hcp2.codec import PROFILE, Read, Write
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.registry import NodeKind, Option, Protocol, device_of

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "hcp2",
            Hcp2Controller,
            device_of("busmaster.protocols.hcp2.device"),
            items=comms_array.FORM,
            probe_item="1",
            documented=comms_array.ITEMS,
            emulated=EMULATED,
            capture_id=2,
        ),
        NodeKind(
            "microflex",
            MicroFlexDrive,
            device_of("busmaster.protocols.hcp2.microflex_device"),
            items=f"an element, or its name: {' '.join(MicroFlexDrive.elements)}",
            probe_item="1",
            documented=microflex.ITEMS,
            emulated=(
                Option("current_control", "flag"),
                Option("host_reference", "flag"),
                Option("ripple", "share"),
                Option("acceleration", "positive"),
                Option("hardware_enable", "flag"),
                Option("stop_input", "flag"),
                Option("axis_error", "whole"),
                Option("drive_error", "whole"),
                Option("trips_after", "positive"),
                Option("firmware", "whole"),
                Option("refuse_unmapped", "flag"),
            ),
            capture_id=3,
        ),
    ),
    commands={"read": Read, "write": Write},
    dialect=Hcp2Dialect,
)
