"""The extended comms array of HCP2 (AN00129): elements 100-255 stand for system parameters; 1-99 are the user's.

15 elements for each of 8 axes from 100 on, then inputs, outputs and the state of the Mint program from 220 on.
MicroFlex uses the same numbers for other things: see `microflex`.
"""

from __future__ import annotations

from collections.abc import Callable

from busmaster.protocols._comms.elements import COMMS, Element, bits, by_name, whole

AXES = 8
ANALOG_INPUTS = 8
FIRST_AXIS_ELEMENT = 100
ELEMENTS_PER_AXIS = 15

AXIS: tuple[tuple[str, Callable[[float], object], str, str], ...] = (
    ("position", float, "actual position", "POS"),
    ("velocity", float, "actual velocity", "VEL"),
    ("mode", whole, "mode of motion", "AXISMODE"),
    ("axis_error", bits, "errors of the axis, a bitmap", "AXISERROR"),
    ("demand", float, "drive demand; restrictions differ by controller", "DAC"),
    ("encoder", float, "encoder position", "ENCODER"),
    ("idle", whole, "not 0 while the motor is in position", "IDLE"),
    ("following_error", float, "positional error", "FOLERROR"),
)
"""The parameters of an axis, from its first element on: name, conversion of the number, meaning, Mint keyword."""


def axis_elements(axis: int) -> list[Element[object]]:
    """Return the parameters of one axis."""
    first = FIRST_AXIS_ELEMENT + ELEMENTS_PER_AXIS * axis
    return [
        Element(f"axis{axis}.{name}", number, decode, meaning, keyword=f"{keyword}({axis})")
        for number, (name, decode, meaning, keyword) in enumerate(AXIS, first)
    ]


INPUTS = Element("inputs", 220, bits, "digital inputs, bank 0", keyword="IN")
OUTPUTS = Element(
    "outputs", 222, bits, "digital outputs, bank 0", keyword="OUT", writable=True, kept="it switches outputs"
)
ANALOG = [
    Element(f"adc{channel}", 224 + channel, float, f"analogue input {channel}", keyword=f"ADC({channel})")
    for channel in range(ANALOG_INPUTS)
]
ERROR = Element("error", 232, whole, "error of the Mint program", keyword="Err")
ERROR_LINE = Element("error_line", 233, whole, "line of that error", keyword="Erl")
ERROR_AXIS = Element("error_axis", 234, whole, "axis of that error", keyword="ErrAxis")
RUNNING = Element("running", 235, whole, "1 while a Mint program runs, else 0")
LINE_NUMBER = Element("line_number", 237, whole, "line that the Mint program is at")
FIRMWARE = Element("firmware", 239, whole, "firmware build", keyword="FIRMWARERELEASE")

STATE: list[Element[object]] = [ERROR, ERROR_LINE, ERROR_AXIS, RUNNING, LINE_NUMBER, FIRMWARE]
AXIS_ELEMENTS: list[Element[object]] = [element for axis in range(AXES) for element in axis_elements(axis)]
IO_ELEMENTS: list[Element[object]] = [INPUTS, OUTPUTS, *ANALOG, *STATE]
ELEMENTS = by_name([*AXIS_ELEMENTS, *IO_ELEMENTS])
"""All element names of the document, in the order of the numbers."""
ITEMS = (*COMMS, *(element.item for element in ELEMENTS.values()))
FORM = (
    f"an element, 1 to 255, or its name: axis0.{AXIS[0][0]} (to axis{AXES - 1}; "
    f"{' '.join(name for name, *_ in AXIS)}), inputs outputs adc0 (to adc{ANALOG_INPUTS - 1}) "
    f"{' '.join(element.name for element in STATE)}"
)
