"""Which protocols there are, and all that the rest of the package knows of one.

A protocol is one `Protocol` object. Those of this package are found by walking `busmaster.protocols`, those of other
packages by their entry points in the group `busmaster.protocols`, when one is first asked for.
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
