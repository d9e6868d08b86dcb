"""The known protocols, and all that the rest of the package knows about each.

A protocol is one `Protocol` object. Protocols of this package are found in `busmaster.protocols`, those of other
packages by their entry points in the group `busmaster.protocols`, when the first one is needed.
"""

from __future__ import annotations

from busmaster.registry.discovery import GROUP, find, kinds, make_device, protocols
from busmaster.registry.protocol import DeviceMaker, NodeKind, Option, Protocol, device_of, everywhere, nowhere

__all__ = [
    "GROUP",
    "DeviceMaker",
    "NodeKind",
    "Option",
    "Protocol",
    "device_of",
    "everywhere",
    "find",
    "kinds",
    "make_device",
    "nowhere",
    "protocols",
]
