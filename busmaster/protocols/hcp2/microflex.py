"""The MicroFlex drive's elements over HCP2 (AN00129, "MicroFlex Extended Comms Array Mappings")."""

from __future__ import annotations

from dataclasses import replace
from enum import IntFlag

from busmaster.contract.items import bits_of
from busmaster.protocols._comms.elements import Element, bits, by_name, whole
from busmaster.protocols.hcp2 import codec as hcp2

FIRST_FIRMWARE = 5221
"""The firmware build that brought this map."""

_RATED_CURRENT = "% of rated current"
_MAX_SPEED = "% of max speed"
"""The maximum speed of the application."""


class CommandWord(IntFlag):
    """Command word of the drive. Bits 0-5 are not defined for MicroFlex. CANCEL must not stay set."""

    CANCEL = 1 << 6
    ENABLE = 1 << 7


class StatusWord(IntFlag):
    """Status word of the drive. Bits 0-2, 4 and 8-15 are not defined for MicroFlex."""

    ASYNCHRONOUS_ERROR = 1 << 3
    STOP_INPUT = 1 << 5
    HARDWARE_ENABLE = 1 << 6
    ENABLED = 1 << 7


COMMAND_BITS = bits_of(
    {
        CommandWord.CANCEL: "cancels asynchronous axis errors; clear it again, since no error latches while it is set",
        CommandWord.ENABLE: "enables the drive, unless there is an axis error or no hardware enable; cleared, disables",
    }
)
STATUS_BITS = bits_of(
    {
        StatusWord.ASYNCHRONOUS_ERROR: "there is an asynchronous or drive error",
        StatusWord.STOP_INPUT: "the general purpose input is an error or stop input, and active",
        StatusWord.HARDWARE_ENABLE: "the hardware enable input is active",
        StatusWord.ENABLED: "the drive is enabled: hardware and software enable are on, and there is no error",
    },
    errors=StatusWord.ASYNCHRONOUS_ERROR,
    warnings=StatusWord.STOP_INPUT,
)


def command_word(value: float) -> CommandWord:
    """Return an element's value as a command word."""
    return CommandWord(bits(value))


def status_word(value: float) -> StatusWord:
    """Return an element's value as a status word."""
    return StatusWord(bits(value))


POSITION = Element("position", 100, float, "position", "counts")
AXIS_ERROR = Element("axis_error", 103, bits, "errors of the axis, a bitmap")
FOLLOWING_ERROR = Element("following_error", 107, float, "how far the position is behind its demand", "counts")
COMMAND_WORD = Element(
    "command_word",
    108,
    command_word,
    "commands to the drive",
    writable=True,
    bits=COMMAND_BITS,
    kept="it enables the drive",
)
STATUS_WORD = Element("status_word", 109, status_word, "state of the drive", bits=STATUS_BITS)
DRIVE_ERROR = Element("drive_error", 110, bits, "errors of the drive, a bitmap")
DEMAND_POSITION = Element("demand_position", 111, float, "position demand", "counts")
TORQUE_REFERENCE = Element(
    "torque_reference",
    116,
    float,
    "torque reference; refused unless in current control and taken from the host",
    _RATED_CURRENT,
    writable=True,
)
TORQUE_DEMAND = Element("torque_demand", 117, float, "torque demand", _RATED_CURRENT)
SPEED_REFERENCE = Element(
    "speed_reference",
    118,
    float,
    "speed reference; refused unless in speed control and taken from the host",
    _MAX_SPEED,
    writable=True,
)
SPEED_DEMAND = Element("speed_demand", 119, float, "speed demand", _MAX_SPEED)
SPEED_MEASURED = Element("speed_measured", 120, float, "measured speed", _MAX_SPEED)
SPEED_ERROR = Element("speed_error", 121, float, "speed demand less measured speed", _MAX_SPEED)
DRIVE_OVERLOAD = Element("drive_overload", 124, float, "how far the drive is into an overload", "%")
MOTOR_OVERLOAD = Element("motor_overload", 125, float, "how far the motor is into an overload", "%")
BUS_VOLTAGE = Element("bus_voltage", 126, float, "DC bus voltage", "V")
CURRENT = Element("current", 127, float, "RMS current of the drive", "A")
CURRENT_U = Element("current_u", 128, float, "current of phase U", "A")
CURRENT_V = Element("current_v", 129, float, "current of phase V", "A")
HALL_STATE = Element("hall_state", 130, bits, "states of the Hall sensors, a bitmap")
ABSOLUTE_ENCODER = Element("absolute_encoder", 131, float, "absolute position, of an SSI encoder", "counts")
PHASE_SEARCH_STATUS = Element("phase_search_status", 132, whole, "state of the phase search")
INPUTS = Element("inputs", 220, bits, "digital inputs, bank 0")
OUTPUTS = Element("outputs", 222, bits, "digital outputs, bank 0: the global error output")
ANALOG_INPUT = Element("analog_input", 224, float, "analogue input 0", "%")
FIRMWARE = Element("firmware", 239, whole, f"firmware build; {FIRST_FIRMWARE} or newer has this map")
TEMPERATURE = Element("temperature", 242, float, "temperature of the drive", "°C")

ELEMENTS = by_name(value for value in list(globals().values()) if isinstance(value, Element))
"""Every name of the map, in the order of the numbers."""
ITEMS = tuple(element.item for element in ELEMENTS.values())

PROFILE = replace(
    hcp2.PROFILE,
    kind="microflex",
    probe=hcp2.Read(STATUS_WORD.number),
    sync_reads=tuple(
        hcp2.Read(element.number)
        for element in (
            FIRMWARE,
            TEMPERATURE,
            BUS_VOLTAGE,
            POSITION,
            AXIS_ERROR,
            FOLLOWING_ERROR,
            DRIVE_ERROR,
            DEMAND_POSITION,
        )
    ),
)
"""HCP2 with the probe and the sync reads of this map. It has no Mint program, and so no elements 1 to 99."""
