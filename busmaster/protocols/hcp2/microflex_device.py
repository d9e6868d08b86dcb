"""A MicroFlex drive (AN00129, "Use of HCP2 and Extended Comms Array on MicroFlex Drive"): HCP2 and its own map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from busmaster.contract.arguments import is_decimal
from busmaster.emulator.device import NEVER, Delay, held
from busmaster.emulator.motion import Ramp
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.device import HCP2, HostCommsDevice, sendable

COMMAND_WORD, TORQUE_REFERENCE, SPEED_REFERENCE = 108, 116, 118

CANCEL = 1 << 6
ENABLE = 1 << 7
COMMAND_BITS = 0xFF

STATUS_ERROR = 1 << 3
STATUS_STOP_INPUT = 1 << 5
STATUS_HARDWARE_ENABLE = 1 << 6
STATUS_ENABLED = 1 << 7

FULL_SPEED = 200_000.0
"""Counts per second at 100 % of the application's maximum speed."""
COUNTS_PER_TURN = 4096
RATED_CURRENT = 3.0
"""RMS amperes at 100 % torque."""
BUS_VOLTAGE = 320.0
AMBIENT = 25.0
HEATING = 40.0
"""Degrees above ambient, in the end, at 100 % torque."""
THERMAL_TIME = 60.0
FRICTION = 0.1
"""Torque per speed, % per %."""
ACCELERATING = 50.0
"""Torque in % while the speed changes."""
LAG = 0.001
"""Following error divided by speed, in seconds."""


@dataclass(slots=True)
class Trip:
    """Future errors: `delay` seconds after `since`, the time of the first request to the drive."""

    delay: float
    errors: int
    drive_errors: int
    since: float = NEVER


class EmulatedMicroFlex(HostCommsDevice):
    """One axis, its command and status word, a speed that follows its reference, errors that latch.

    `current_control` False: speed control. `host_reference`: the references come from the host. Otherwise writes to
    the reference that does not apply are refused. `ripple`: share, 0 to 1, by which the measured speed varies with
    every turn. Writes to unmapped elements are refused. Reads of them are refused too; without `refuse_unmapped` they
    return 0, and with `ignore_unmapped` they have no reply, because the document does not define it.
    """

    def __init__(
        self,
        address: int,
        *,
        current_control: bool = False,
        host_reference: bool = True,
        ripple: float = 0.0,
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
        refuse_unmapped: bool = True,
        ignore_unmapped: bool = False,
        firmware: int = 5221,
        acceleration: float = 50.0,
    ) -> None:
        super().__init__(address, HCP2, delay=delay, traceable=traceable)
        self.current_control = current_control
        self.host_reference = host_reference
        self.ripple = ripple
        self.refuse_unmapped = refuse_unmapped
        self.ignore_unmapped = ignore_unmapped
        self.firmware = firmware
        self.hardware_enable = True
        self.stop_input = False
        """An input set up as error or stop input is active."""
        self.inputs = 0
        self.analog_input = 0.0
        self.axis_error = 0
        """Latched asynchronous errors, a bitmap."""
        self.drive_error = 0
        self.causes = 0
        """The axis errors that cannot be cancelled, because their cause still exists."""
        self.command_word = 0
        self.speed_reference = 0.0
        self.torque_reference = 0.0
        self.enabled = False
        self._motor = Ramp(acceleration)
        self._trip: Trip | None = None
        self._temperature = AMBIENT
        self._updated = -math.inf

    # Presets and errors

    def preset(self, item: str, *values: float) -> None:
        """Set an element and those after it: position, errors, command word, references, I/O, firmware."""
        first = int(item) if is_decimal(item) else 0
        for element, value in enumerate(values, first):
            if not self._hold(element, value):
                raise InvalidCommand(f"an emulated drive's element {element if first else item!r} cannot be given")

    def _hold(self, element: int, value: float) -> bool:
        value = sendable(value, element)
        match element:
            case 100 | 131:
                self._motor.position = value / FULL_SPEED * 100
            case 103:
                self.trip(held(value, 0, 0xFFFF_FFFF, "axis_error"), 0.0)
            case 108:
                self.command(held(value, 0, COMMAND_BITS, "command_word"), 0.0)
            case 110:
                self.trip(0, 0.0, held(value, 0, 0xFFFF_FFFF, "drive_error"))
            case 116:
                self.torque_reference = value
            case 118:
                self.speed_reference = value
            case 220:
                self.inputs = held(value, 0, 0xFFFF, "inputs")
            case 224:
                self.analog_input = value
            case 239:
                self.firmware = held(value, 0, 0xFFFF_FFFF, "firmware")
            case _:
                return False
        self._apply(0.0)
        return True

    def trip_after(self, delay: float, errors: int, drive_errors: int = 0) -> None:
        """Trip the drive `delay` seconds after the first request."""
        self._trip = Trip(delay, errors, drive_errors)

    def trip(self, errors: int, now: float, drive_errors: int = 0) -> None:
        """Cause errors, which disable the drive and latch. Axis errors are ignored while the cancel bit is set."""
        self._update(now)
        self.drive_error |= drive_errors
        if not self.command_word & CANCEL:
            self.axis_error |= errors
        self._apply(now)

    def set_hardware_enable(self, active: bool, now: float) -> None:
        """Set the hardware enable input.

        Without it the drive is disabled. When it returns, the drive stays disabled until the next command.
        """
        self._update(now)
        self.hardware_enable = active
        self._apply(now)

    def restart(self, now: float) -> None:
        super().restart(now)
        self.command_word = 0
        self.enabled = False
        self.speed_reference = self.torque_reference = 0.0
        self.axis_error = self.causes
        self.drive_error = 0
        self._motor = Ramp(self._motor.rate, now=now)
        self._apply(now)

    def command(self, word: int, now: float) -> None:
        """Execute a write to the command word."""
        self._update(now)
        self.command_word = word
        if word & CANCEL:
            self.axis_error &= self.causes
            self.drive_error = 0
        self.enabled = bool(word & ENABLE)
        self._apply(now)

    # The elements

    def read_element(self, element: int, now: float) -> float | None:
        self._update(now)
        value = self._read_mapped(element)
        return 0 if value is None and not self.refuse_unmapped else value

    def _answer_read(self, element: int, now: float) -> None:
        if self.ignore_unmapped and self.traceable is None and self._read_mapped(element) is None:
            return
        super()._answer_read(element, now)

    def _read_mapped(self, element: int) -> float | None:
        return self._read_axis(element) if element < 220 else self._read_io(element)

    def write_element(self, element: int, value: float, now: float) -> bool:
        if not self.writable(element):
            return False
        self._update(now)
        if element == COMMAND_WORD:
            word = round(value)
            if not 0 <= word <= COMMAND_BITS:
                return False
            self.command(word, now)
        elif element == SPEED_REFERENCE:
            self.speed_reference = value
        else:
            self.torque_reference = value
        self._apply(now)
        return True

    def writable(self, element: int) -> bool:
        if element == COMMAND_WORD:
            return True
        # the outputs too are read-only here, unlike those of a controller
        applies = TORQUE_REFERENCE if self.current_control else SPEED_REFERENCE
        return self.host_reference and element == applies

    @property
    def status_word(self) -> int:
        """The status word, as in element 109."""
        return (
            STATUS_ERROR * bool(self.axis_error or self.drive_error)
            | STATUS_STOP_INPUT * self.stop_input
            | STATUS_HARDWARE_ENABLE * self.hardware_enable
            | STATUS_ENABLED * self.enabled
        )

    def _read_axis(self, element: int) -> float | None:
        match element:
            case 100 | 131:
                return round(self._position)
            case 103:
                return self.axis_error
            case 107:
                return round(self._motor.speed / 100 * FULL_SPEED * LAG)
            case 108:
                return self.command_word
            case 109:
                return self.status_word
            case 110:
                return self.drive_error
            case 111:
                return round(self._position + self._motor.speed / 100 * FULL_SPEED * LAG)
            case 116:
                return self.torque_reference
            case 117:
                return self._torque
            case 118:
                return self.speed_reference
            case 119:
                return self._motor.target
            case 120:
                return self._speed
            case 121:
                return self._motor.target - self._speed
            case 124 | 125:
                return max(0.0, abs(self._torque) - 100)
            case 126:
                return BUS_VOLTAGE - 0.05 * abs(self._torque)
            case 127:
                return self._current
            case 128:
                return self._current * math.sqrt(2) * math.sin(self._angle)
            case 129:
                return self._current * math.sqrt(2) * math.sin(self._angle - math.tau / 3)
            case 130:
                return (0b001, 0b011, 0b010, 0b110, 0b100, 0b101)[int(self._angle / math.tau * 6) % 6]
            case 132:
                return 0
        return None

    def _read_io(self, element: int) -> float | None:
        match element:
            case 220:
                return self.inputs
            case 222:
                return int(bool(self.axis_error or self.drive_error))
            case 224:
                return self.analog_input
            case 239:
                return self.firmware
            case 242:
                return self._temperature
        return None

    # The motor

    @property
    def _position(self) -> float:
        return self._motor.position / 100 * FULL_SPEED

    @property
    def _angle(self) -> float:
        """Angle of the shaft, in radians."""
        return self._position % COUNTS_PER_TURN / COUNTS_PER_TURN * math.tau

    @property
    def _speed(self) -> float:
        return self._motor.speed * (1 + self.ripple * math.sin(self._angle))

    @property
    def _torque(self) -> float:
        """Torque demand, in %."""
        if not self.enabled:
            return 0.0
        if self.current_control:
            return self.torque_reference
        change = self._motor.target - self._motor.speed
        accelerating = math.copysign(ACCELERATING, change) if change else 0.0
        return self._speed * FRICTION * (1 + 10 * self.ripple * math.cos(self._angle)) + accelerating

    @property
    def _current(self) -> float:
        return abs(self._torque) / 100 * RATED_CURRENT

    def _update(self, now: float) -> None:
        """Update position and temperature to the time `now`."""
        if now > self._updated:
            self._motor.advance(now)
            final = AMBIENT + HEATING * abs(self._torque) / 100
            self._temperature += (final - self._temperature) * -math.expm1((self._updated - now) / THERMAL_TIME)
            self._updated = now
        self._trip_if_due(now)

    def _trip_if_due(self, now: float) -> None:
        trip = self._trip
        if trip is None:
            return
        trip.since = min(trip.since, now)
        if now >= trip.since + trip.delay:
            self._trip = None
            self.trip(trip.errors, now, trip.drive_errors)

    def _apply(self, now: float) -> None:
        """Decide whether the drive runs, and its target speed. While the cancel bit is set, it does not move."""
        if self.axis_error or self.drive_error or not self.hardware_enable:
            self.enabled = False
        reference = self.torque_reference if self.current_control else self.speed_reference
        runs = self.enabled and not self.command_word & CANCEL and not self.stop_input
        self._motor.target = reference if runs else 0.0


def make_device(
    address: int,
    *,
    lively: bool,
    ripple: float | None = None,
    hardware_enable: bool = True,
    stop_input: bool = False,
    axis_error: int = 0,
    drive_error: int = 0,
    trips_after: float | None = None,
    **options: Any,
) -> EmulatedMicroFlex:
    """Make a drive; if it is lively, it runs.

    With errors given it has tripped, or trips `trips_after` seconds after the first request.
    """
    drive = EmulatedMicroFlex(address, ripple=(0.01 if lively else 0.0) if ripple is None else ripple, **options)
    drive.hardware_enable = hardware_enable
    drive.stop_input = stop_input
    if lively:
        drive.speed_reference = drive.torque_reference = 20.0 + 5 * (address % 8)
        drive.command(ENABLE, 0.0)
    if trips_after is not None:
        drive.trip_after(trips_after, axis_error, drive_error)
    elif axis_error or drive_error:
        drive.trip(axis_error, 0.0, drive_error)
    return drive
