"""Host Comms Protocol (AN00110)."""

from __future__ import annotations

from busmaster.protocols._comms import EMULATED
from busmaster.protocols._comms.elements import COMMS
from busmaster.protocols.hcp.capture import HcpDialect
from busmaster.protocols.hcp.codec import PROFILE, Read, Write
from busmaster.protocols.hcp.handle import HcpController
from busmaster.registry import NodeKind, Protocol, device_of

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "hcp",
            HcpController,
            device_of("busmaster.protocols.hcp.device"),
            items="a comms element, 1 to 99",
            probe_item="1",
            documented=COMMS,
            emulated=EMULATED,
            capture_id=1,
        ),
    ),
    commands={"read": Read, "write": Write},
    dialect=HcpDialect,
)
