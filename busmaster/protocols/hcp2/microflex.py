"""The MicroFlex drive's elements over HCP2 (AN00129, "MicroFlex Extended Comms Array Mappings")."""

from __future__ import annotations

from enum import IntFlag

from busmaster.protocols._comms.elements import Element, bits, by_name, whole

FIRST_FIRMWARE = 5221
"""The firmware build that brought this map."""

_RATED_CURRENT = "% of rated current"
_MAX_SPEED = "% of max speed"


class CommandWord(IntFlag):
    """What the drive is told. Bits 0-5 are not defined for MicroFlex."""

    CANCEL = 1 << 6
    """Cancels asynchronous axis errors. It must not stay set: while it is, new errors do not latch."""
    ENABLE = 1 << 7
    """Enables the drive if there is no axis error and the hardware enable is active; cleared, it disables."""


class StatusWord(IntFlag):
    """What the drive says. Bits 0-2, 4 and 8-15 are not defined for MicroFlex."""

    ASYNCHRONOUS_ERROR = 1 << 3
    """There is an asynchronous or drive error."""
    STOP_INPUT = 1 << 5
    """The general purpose input is an error or stop input, and active."""
    HARDWARE_ENABLE = 1 << 6
    """The hardware enable input is active."""
    ENABLED = 1 << 7
    """Hardware and software enable are on, and there is no error."""


def command_word(value: float) -> CommandWord:
    return CommandWord(bits(value))


def status_word(value: float) -> StatusWord:
    return StatusWord(bits(value))


POSITION = Element("position", 100, float, "counts")
AXIS_ERROR = Element("axis_error", 103, bits)
FOLLOWING_ERROR = Element("following_error", 107, float, "counts")
COMMAND_WORD = Element("command_word", 108, command_word, writable=True)
STATUS_WORD = Element("status_word", 109, status_word)
DRIVE_ERROR = Element("drive_error", 110, bits)
DEMAND_POSITION = Element("demand_position", 111, float, "counts")
TORQUE_REFERENCE = Element("torque_reference", 116, float, _RATED_CURRENT, writable=True)
"""Refused unless the drive is in current control and takes its reference from the host."""
TORQUE_DEMAND = Element("torque_demand", 117, float, _RATED_CURRENT)
SPEED_REFERENCE = Element("speed_reference", 118, float, _MAX_SPEED, writable=True)
"""Refused unless the drive is in speed control and takes its reference from the host."""
SPEED_DEMAND = Element("speed_demand", 119, float, _MAX_SPEED)
SPEED_MEASURED = Element("speed_measured", 120, float, _MAX_SPEED)
SPEED_ERROR = Element("speed_error", 121, float, _MAX_SPEED)
DRIVE_OVERLOAD = Element("drive_overload", 124, float, "%")
MOTOR_OVERLOAD = Element("motor_overload", 125, float, "%")
BUS_VOLTAGE = Element("bus_voltage", 126, float, "V")
CURRENT = Element("current", 127, float, "A")
CURRENT_U = Element("current_u", 128, float, "A")
CURRENT_V = Element("current_v", 129, float, "A")
HALL_STATE = Element("hall_state", 130, bits)
ABSOLUTE_ENCODER = Element("absolute_encoder", 131, float, "counts")
PHASE_SEARCH_STATUS = Element("phase_search_status", 132, whole)
INPUTS = Element("inputs", 220, bits)
OUTPUTS = Element("outputs", 222, bits)
ANALOG_INPUT = Element("analog_input", 224, float, "%")
FIRMWARE = Element("firmware", 239, whole)
TEMPERATURE = Element("temperature", 242, float, "°C")

ELEMENTS = by_name(value for value in list(globals().values()) if isinstance(value, Element))
"""Every name of the map, in the order of the numbers."""
