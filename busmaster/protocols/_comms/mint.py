"""A Mint controller: 99 elements to read and write, and in HCP2 the extended comms array on top of its axes and I/O."""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Sequence
from typing import Any

from busmaster.contract.arguments import is_decimal
from busmaster.emulator.device import NEVER, Delay, held
from busmaster.emulator.motion import Axis, Motion
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.device import HCP2, Framing, HostCommsDevice, sendable

LAST_COMMS = 99
FIRST_AXIS = 100
AXIS_SIZE = 15
AXES = 8
FIRST_IO = FIRST_AXIS + AXES * AXIS_SIZE
OUTPUTS = 222
FIRST_ADC, LAST_ADC = 224, 231
IO = {220: "inputs", OUTPUTS: "outputs", 239: "firmware"}
LAST_EVENT = 5
REPORTED = range(11, 11 + AXES)
"""Elements that `report_positions` writes."""
COUNTS = 1000.0
"""Encoder counts per unit of position."""
FULL_SPEED = 100.0
"""Units per second at a drive demand of 100 %."""
LAG = 0.002
"""Following error divided by speed, in seconds."""
GREATEST_SINGLE = struct.unpack(">f", b"\x7f\x7f\xff\xff")[0]

Program = Callable[["EmulatedMint"], Generator[int, None, None]]
"""A program of a controller: a generator that executes one statement per step and yields the number of its line."""
Event = Callable[["EmulatedMint", int, float], None]
"""`Event commsX`: called with the controller, the element (1 to 5) and the time."""


class EmulatedMint(HostCommsDevice):
    """Eight axes, I/O, and a comms array. By default it runs no program and has no events.

    With fewer than 8 `axes`, the elements of the others are reserved. Reserved elements read 0 and refuse writes;
    `refuse_reserved` refuses reads too. `single_precision` stores values with 24 bits, like a real controller.
    `statement`: seconds that a statement of the program takes.
    """

    def __init__(
        self,
        address: int,
        framing: Framing = HCP2,
        *,
        axes: int = AXES,
        program: Program | None = None,
        events: Sequence[Event] = (),
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
        fixed_decimals: bool = False,
        all_or_nothing: bool = False,
        refuse_reserved: bool = False,
        single_precision: bool = False,
        statement: float = 0.001,
        firmware: int = 5628,
    ) -> None:
        super().__init__(
            address,
            framing,
            delay=delay,
            traceable=traceable,
            fixed_decimals=fixed_decimals,
            all_or_nothing=all_or_nothing,
        )
        self.comms = [0.0] * (LAST_COMMS + 1)
        """Comms(1) to Comms(99); [0] is not used."""
        self.axes = [Axis() for _ in range(axes)]
        self.inputs = 0
        self.outputs = 0
        self.adc = [0.0] * (LAST_ADC - FIRST_ADC + 1)
        """Analog channels in %."""
        self.events = list(events)
        self.firmware = firmware
        self.refuse_reserved = refuse_reserved
        self.single_precision = single_precision
        self.statement = statement
        self.now = NEVER
        """Time of the running statement; NEVER before the first."""
        self.line_number = 0
        self.program = program
        self._run: Generator[int, None, None] | None = None
        self.start_program()

    def preset(self, item: str, *values: float) -> None:
        """Set an element and those after it: of the comms array, a position, an axis error, or I/O.

        An axis whose position is given stands still. Positions are not reported into elements that are given.
        """
        first = int(item) if is_decimal(item) else 0
        for element, value in enumerate(values, first):
            if not 1 <= element <= self.framing.last_element or not self._hold(element, value):
                raise InvalidCommand(f"an emulated controller's element {element if first else item!r} cannot be given")

    def _hold(self, element: int, value: float) -> bool:
        value = sendable(value, element)
        number, offset = divmod(element - FIRST_AXIS, AXIS_SIZE)
        if element <= LAST_COMMS:
            self.comms[element] = single(value) if self.single_precision else value
            if self.program is report_positions and element in REPORTED:
                self.program = self._run = None
        elif element < FIRST_IO and number < len(self.axes) and offset in (0, 3):
            if offset == 0:
                self.axes[number].place(value, 0.0)
            else:
                self.axes[number].error = held(value, 0, 0xFFFF_FFFF, "an axis error")
        elif FIRST_ADC <= element <= LAST_ADC:
            self.adc[element - FIRST_ADC] = value
        elif element in IO:
            setattr(self, IO[element], held(value, 0, 0xFFFF_FFFF, IO[element]))
        else:
            return False
        return True

    # The program

    def start_program(self) -> None:
        """Start with the first statement and the current comms array. Its time begins with the next request."""
        self.now = NEVER
        self._run = None if self.program is None else self.program(self)

    def run(self, now: float) -> None:
        """Execute the statements that are due by `now`."""
        if self.now == NEVER:
            self.now = now
        while self._run is not None and self.now + self.statement <= now:
            self.now += self.statement
            try:
                self.line_number = next(self._run)
            except StopIteration:
                self._run = None

    def restart(self, now: float) -> None:
        super().restart(now)
        self.comms = [0.0] * (LAST_COMMS + 1)
        self.outputs = 0
        self.axes = [Axis() for _ in self.axes]
        self.start_program()

    # The elements

    def read_element(self, element: int, now: float) -> float | None:
        if self._run is not None:
            self.run(now)
        if element <= LAST_COMMS:
            return self.comms[element]
        value = self._read_io(element) if element >= FIRST_IO else self._read_axis(element, now)
        if value is None and not self.refuse_reserved:
            return 0  # AN00129 does not define the reply of reserved elements
        return value

    def write_element(self, element: int, value: float, now: float) -> bool:
        if self._run is not None:
            self.run(now)
        if element > LAST_COMMS:
            if element == OUTPUTS:
                self.outputs = round(value)
            return element == OUTPUTS
        self.comms[element] = single(value) if self.single_precision else value
        if element <= LAST_EVENT:  # an event starts even if the value is the same
            for event in self.events:
                event(self, element, now)
        return True

    def writable(self, element: int) -> bool:
        return element <= LAST_COMMS or element == OUTPUTS

    def _read_axis(self, element: int, now: float) -> float | None:
        number, offset = divmod(element - FIRST_AXIS, AXIS_SIZE)
        if number >= len(self.axes):
            return None
        axis = self.axes[number]
        match offset:
            case 0:
                return axis.position(now)
            case 1:
                return axis.velocity(now)
            case 2:
                axis.position(now)
                return axis.motion
            case 3:
                return axis.error
            case 4:
                return axis.velocity(now) / FULL_SPEED * 100
            case 5:
                return round(axis.position(now) * COUNTS)
            case 6:
                return axis.idle(now)
            case 7:
                return axis.velocity(now) * LAG
        return None

    def _read_io(self, element: int) -> float | None:
        if FIRST_ADC <= element <= LAST_ADC:
            return self.adc[element - FIRST_ADC]
        match element:
            case 220:
                return self.inputs
            case 222:
                return self.outputs
            case 232 | 233:
                return 0
            case 234:
                return next((number for number, axis in enumerate(self.axes) if axis.error), 0)
            case 235:
                return self._run is not None
            case 237:
                return self.line_number
            case 239:
                return self.firmware
        return None


def single(value: float) -> float:
    """Return the value in single precision; outside its range, the largest value of that sign."""
    value = max(-GREATEST_SINGLE, min(value, GREATEST_SINGLE))
    kept: float = struct.unpack("f", struct.pack("f", value))[0]
    return kept


# The programs of the documents (AN00110 and AN00129, "Use of the Comms Array" and "Events")


def winding(mint: EmulatedMint) -> Generator[int, None, None]:
    """Traverse a drum between Comms(1) and Comms(2) at the ratio Comms(3); Comms(4) is its position.

    The drum whose rotation axis 0 follows turns at 1 unit a second.
    """
    comms, axis = mint.comms, mint.axes[0]
    comms[3] = 0
    yield 1
    while True:
        yield 2
        if axis.position(mint.now) > comms[2]:
            axis.follow(-comms[3], mint.now)
        yield 3
        if axis.position(mint.now) < comms[1]:
            axis.follow(comms[3], mint.now)
        yield 4
        comms[4] = axis.position(mint.now)
        yield 5


def command_handshake(mint: EmulatedMint) -> Generator[int, None, None]:
    """Execute a command in Comms(1) with its data in Comms(2) to Comms(4). Comms(1) is 0 when it is done.

    The race is in the document's program: its last line clears Comms(1) in any case. A command that is written between
    the read and the clear is lost, although the host reads zero.
    """
    comms, axis = mint.comms, mint.axes[1]
    comms[1] = 0
    yield 2
    while True:
        yield 3
        command = round(comms[1])
        yield 4
        if command:
            yield 5
            if command in (1, 2):
                axis.speed = abs(comms[2])
                yield 5 + command
                axis.move(comms[3] + (axis.position(mint.now) if command == 2 else 0), mint.now)
                yield 5 + command
            elif command == 3:
                axis.move(0.0, mint.now, Motion.HOME)
                yield 8
            while not axis.idle(mint.now):
                yield 5 + min(command, 3)
        yield 9
        comms[1] = 0
        yield 10


def report_positions(mint: EmulatedMint) -> Generator[int, None, None]:
    """Keep Comms(11) to Comms(18) at the positions of the axes, for a host that speaks HCP: not in the documents."""
    while True:
        for number, axis in enumerate(mint.axes):
            mint.comms[REPORTED[number]] = axis.position(mint.now)
        yield 1


def jog_on_comms1(mint: EmulatedMint, element: int, now: float) -> None:
    """Do as `Event comms1` does: JOG(0) = COMMS(1), on every write to Comms(1), of an equal value too."""
    if element == 1:
        mint.axes[0].jog(mint.comms[1], now)


PROGRAMS = {program.__name__: program for program in (winding, command_handshake, report_positions)}

AXES_NEEDED: dict[str | None, int] = {command_handshake.__name__: 2}
SHORTEST_STATEMENT = 0.0001
"""Seconds: a program is caught up with statement by statement."""


def make_mint(
    framing: Framing,
    address: int,
    *,
    lively: bool,
    program: str | None = None,
    axes: int = AXES,
    jogs_on_comms1: bool = False,
    statement: float | None = None,
    **options: Any,
) -> EmulatedMint:
    """Make a controller that runs a program of the documents.

    If it is lively and no program is given, its axes swing, and a program reports their positions in its elements.
    """
    if not AXES_NEEDED.get(program, 1) <= axes <= AXES:
        raise InvalidCommand(
            f"a controller has {AXES_NEEDED.get(program, 1)} to {AXES} axes for its program, not {axes}"
        )
    if statement is not None and statement < SHORTEST_STATEMENT:
        raise InvalidCommand(f"a statement takes {SHORTEST_STATEMENT} s at least, not {statement:g} s")
    swings = lively and program is None
    controller = EmulatedMint(
        address,
        framing,
        axes=axes,
        program=report_positions if swings else PROGRAMS[program] if program else None,
        events=(jog_on_comms1,) if jogs_on_comms1 else (),
        statement=statement or (0.05 if swings else 0.001),
        **options,
    )
    if swings:
        for number, axis in enumerate(controller.axes):
            axis.swing(100.0, 8.0 + number, address / 7 + number / 3, 0.0)
    return controller
