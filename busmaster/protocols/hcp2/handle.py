"""The handle of a controller with HCP2."""

from __future__ import annotations

from typing import Any, ClassVar

from busmaster.bus.points import Point
from busmaster.contract.arguments import whole_number
from busmaster.contract.profile import Profile
from busmaster.protocols._comms.handle import MintHandle, Named
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import comms_array


class Hcp2Controller(MintHandle):
    """A Mint controller over HCP2: nodes 0-255, comms elements 1-99 and the extended comms array, 100-255.

        controller = Hcp2Controller(bus, 5)
        await controller.write(1, 123.456)
        position = await controller.axis(0).position.read()
        await controller.io.outputs.write(0b101)

    `read` and `write` access comms elements by their number.
    """

    profile: ClassVar[Profile] = hcp2.PROFILE
    _read_command = hcp2.Read
    _write_command = hcp2.Write
    elements = comms_array.ELEMENTS
    _identity = (comms_array.FIRMWARE.name,)
    _form = "an element number, 1 to 255, or a name such as axis0.position"

    def axis(self, number: int) -> Axis:
        """Return the points of an axis. Raises InvalidCommand unless `number` is 0 to 7."""
        return Axis(self, number)

    @property
    def io(self) -> Io:
        """The points that do not belong to an axis."""
        return Io(self)


class Io:
    """The points that do not belong to an axis: inputs, outputs, and the state of the Mint program."""

    inputs = Named(comms_array.INPUTS)
    outputs = Named(comms_array.OUTPUTS)
    error = Named(comms_array.ERROR)
    error_line = Named(comms_array.ERROR_LINE)
    error_axis = Named(comms_array.ERROR_AXIS)
    running = Named(comms_array.RUNNING)
    line_number = Named(comms_array.LINE_NUMBER)
    firmware = Named(comms_array.FIRMWARE)

    def __init__(self, controller: Hcp2Controller) -> None:
        self.named = controller.named

    def adc(self, channel: int) -> Point[float]:
        """Return the point of an analogue input. Raises InvalidCommand unless `channel` is 0 to 7."""
        return self.named(comms_array.ANALOG[whole_number(channel, 0, comms_array.ANALOG_INPUTS - 1, "a channel")])


class Axis:
    """The points of one axis, by the names of the document."""

    def __init__(self, controller: Hcp2Controller, number: int) -> None:
        self.controller = controller
        self.number = whole_number(number, 0, comms_array.AXES - 1, "an axis")

    def __repr__(self) -> str:
        return f"<Axis {self.number} of {self.controller.node.label}>"

    @property
    def position(self) -> Point[float]:
        """Actual position (POS)."""
        return self._point("position")

    @property
    def velocity(self) -> Point[float]:
        """Actual velocity (VEL)."""
        return self._point("velocity")

    @property
    def mode(self) -> Point[int]:
        """Mode of motion (AXISMODE)."""
        return self._point("mode")

    @property
    def axis_error(self) -> Point[int]:
        """Bitmap of errors (AXISERROR)."""
        return self._point("axis_error")

    @property
    def demand(self) -> Point[float]:
        """Drive demand (DAC)."""
        return self._point("demand")

    @property
    def encoder(self) -> Point[float]:
        """Encoder position (ENCODER)."""
        return self._point("encoder")

    @property
    def idle(self) -> Point[int]:
        """Not 0 while the motor is in position (IDLE)."""
        return self._point("idle")

    @property
    def following_error(self) -> Point[float]:
        """Positional error (FOLERROR)."""
        return self._point("following_error")

    def _point(self, name: str) -> Point[Any]:
        return self.controller.point(f"axis{self.number}.{name}")
