"""The extended comms array of HCP2 (AN00129): elements 100-255 stand for system parameters; 1-99 are the user's.

15 elements for each of 8 axes from 100 on, then inputs, outputs and the state of the Mint program from 220 on.
MicroFlex uses the same numbers for other things: see `microflex`.
"""

from __future__ import annotations

from busmaster.protocols._comms.elements import Element, bits, by_name, whole

AXES = 8
ANALOG_INPUTS = 8
FIRST_AXIS_ELEMENT = 100
ELEMENTS_PER_AXIS = 15


def axis_elements(axis: int) -> list[Element[object]]:
    """The parameters of one axis, by the Mint keyword that each stands for."""
    first = FIRST_AXIS_ELEMENT + ELEMENTS_PER_AXIS * axis
    return [
        Element(f"axis{axis}.position", first, float),  # POS
        Element(f"axis{axis}.velocity", first + 1, float),  # VEL
        Element(f"axis{axis}.mode", first + 2, whole),  # AXISMODE
        Element(f"axis{axis}.axis_error", first + 3, bits),  # AXISERROR
        Element(f"axis{axis}.demand", first + 4, float),  # DAC
        Element(f"axis{axis}.encoder", first + 5, float),  # ENCODER
        Element(f"axis{axis}.idle", first + 6, whole),  # IDLE
        Element(f"axis{axis}.following_error", first + 7, float),  # FOLERROR
    ]


INPUTS = Element("inputs", 220, bits)  # IN
OUTPUTS = Element("outputs", 222, bits, writable=True)  # OUT
ANALOG = [Element(f"adc{channel}", 224 + channel, float) for channel in range(ANALOG_INPUTS)]  # ADC
ERROR = Element("error", 232, whole)  # Err
ERROR_LINE = Element("error_line", 233, whole)  # Erl
ERROR_AXIS = Element("error_axis", 234, whole)  # ErrAxis
RUNNING = Element("running", 235, whole)
"""1 while a Mint program runs, else 0."""
LINE_NUMBER = Element("line_number", 237, whole)
FIRMWARE = Element("firmware", 239, whole)  # FIRMWARERELEASE

AXIS_ELEMENTS: list[Element[object]] = [element for axis in range(AXES) for element in axis_elements(axis)]
IO_ELEMENTS: list[Element[object]] = [
    INPUTS,
    OUTPUTS,
    *ANALOG,
    ERROR,
    ERROR_LINE,
    ERROR_AXIS,
    RUNNING,
    LINE_NUMBER,
    FIRMWARE,
]
ELEMENTS = by_name([*AXIS_ELEMENTS, *IO_ELEMENTS])
"""Every name that the document gives to an element, in the order of the numbers."""
