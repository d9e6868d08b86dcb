"""Host Comms Protocol 2 (AN00129): Mint controllers, and MicroFlex drives with a map of their own."""

from __future__ import annotations

from busmaster.protocols._comms import EMULATED
from busmaster.protocols.hcp2 import comms_array, microflex
from busmaster.protocols.hcp2.capture import Hcp2Dialect
from busmaster.protocols.hcp2.codec import PROFILE, Read, Write
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex import CommandWord, StatusWord
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.registry import NodeKind, Option, Protocol, device_of

__all__ = ["PROTOCOL", "CommandWord", "Read", "StatusWord", "Write"]

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
            probe_item="status_word",
            documented=microflex.ITEMS,
            emulated=(
                Option(
                    "current_control",
                    "flag",
                    about="It controls torque, not speed: the speed reference refuses writes.",
                ),
                Option(
                    "host_reference",
                    "flag",
                    about="The references come from the host, true by default; false: they refuse writes.",
                ),
                Option(
                    "ripple",
                    "share",
                    about="Share, 0 to 1, by which the measured speed varies with every turn; 0.01 by default, 0 if "
                    "the drive is not lively.",
                ),
                Option(
                    "acceleration",
                    "positive",
                    about="How fast its speed follows the reference, in % a second; 50 by default.",
                ),
                Option("hardware_enable", "flag", about="Its enable input is on, true by default."),
                Option("stop_input", "flag", about="An input that is configured as error or stop input is on."),
                Option("axis_error", "whole", about="The axis errors with which it has tripped, or trips: a bitmap."),
                Option("drive_error", "whole", about="The drive error with which it has tripped, or trips."),
                Option(
                    "trips_after",
                    "positive",
                    about="It trips this many seconds after the first request, and has not tripped before.",
                ),
                Option("firmware", "whole", about="Its firmware's build; 5221 by default."),
                Option(
                    "refuse_unmapped",
                    "flag",
                    about="It refuses to read elements that its map does not have, true by default; false: they read "
                    "0.",
                ),
                Option(
                    "ignore_unmapped",
                    "flag",
                    about="It does not reply to a read of an element that its map does not have.",
                ),
            ),
            capture_id=3,
        ),
    ),
    commands={"read": Read, "write": Write},
    dialect=Hcp2Dialect,
)
