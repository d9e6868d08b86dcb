"""Host Comms Protocol 2 (AN00129): Mint controllers, and MicroFlex drives with a map of their own."""

from __future__ import annotations

from busmaster.protocols.hcp2 import comms_array, microflex
from busmaster.protocols.hcp2.capture import Hcp2Dialect
from busmaster.protocols.hcp2.codec import PROFILE, Read, Write
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.registry import NodeKind, Protocol, device_of

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "hcp2",
            Hcp2Controller,
            device_of("busmaster.protocols.hcp2.device"),
            items=comms_array.FORM,
            documented=comms_array.ITEMS,
            capture_id=2,
        ),
        NodeKind(
            "microflex",
            MicroFlexDrive,
            device_of("busmaster.protocols.hcp2.microflex_device"),
            items=f"an element, or its name: {' '.join(MicroFlexDrive.elements)}",
            documented=microflex.ITEMS,
            capture_id=3,
        ),
    ),
    commands={"read": Read, "write": Write},
    dialect=Hcp2Dialect,
)
