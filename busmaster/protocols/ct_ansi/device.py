"""An emulated drive with CT-ANSI (Unidrive, Commander): Mentor II's frames, values with a decimal point."""

from __future__ import annotations

import re
from decimal import Decimal
from functools import partial
from typing import Any

from busmaster.errors import InvalidCommand
from busmaster.protocols.mentor.device import FINE, SPEED_FEEDBACK, EmulatedMentor, Parameter
from busmaster.protocols.mentor.device import make_device as make_mentor
from busmaster.wire.checks import bcc

VALUE = re.compile(rb" *[+-]?(\d+\.?\d*|\.\d+)", re.ASCII)
LONGEST_VALUE = 12


class EmulatedCtAnsi(EmulatedMentor):
    """Addresses 11 to 99 without the tens. Menus as in Mentor II; references and feedback have one decimal, in %.

    Other options are those of a Mentor II. `plus`: values from 0 up are sent with a sign. `width`: values are filled
    with zeros to this number of characters.
    """

    def __init__(
        self,
        address: int,
        *,
        plus: bool = False,
        width: int = 0,
        **options: Any,
    ) -> None:
        if address % 10 == 0 or address < 11:
            raise InvalidCommand(f"a drive has an address from 11 to 99 without the tens, not {address}")
        if width > LONGEST_VALUE:
            raise InvalidCommand(f"a value has {LONGEST_VALUE} characters at most, not {width}")
        super().__init__(address, **options)
        self.plus = plus
        self.width = width

    def has_decimal(self, parameter: int) -> bool:
        """Return True if the parameter has a decimal. 117 is 01.17."""
        return self.parameters[parameter].fine or parameter == SPEED_FEEDBACK

    def steps(self, parameter: int, value: float) -> float:
        """Return the whole number for a value on the line: tenths for a parameter with a decimal."""
        return round(value * FINE, 6) if self.has_decimal(parameter) else value

    def _telegram(self, parameter: int, now: float) -> bytes:
        number = self.value(parameter, now)
        sign = "-" if number < 0 else "+" if self.plus else ""
        digits = str(abs(number))
        if self.has_decimal(parameter) and self.traceable is None:
            digits = f"{abs(number) // FINE}.{abs(number) % FINE}"
        summed = b"%04d" % parameter + (sign + digits.zfill(self.width - len(sign))).encode() + b"\x03"
        return b"\x02" + summed + bytes((bcc(summed),))

    def _fine_of(self, parameter: Parameter, data: bytes) -> int | None:
        """Return the steps of a written value, or None if it is refused.

        A parameter with a decimal counts in tenths of a percent, and refuses finer values.
        """
        if not VALUE.fullmatch(data) or len(data) > LONGEST_VALUE:
            return None
        value = Decimal(data.decode().strip())
        steps = value * FINE if self.traceable is None and parameter.fine else value
        return int(steps) * FINE if steps == int(steps) else None


make_device = partial(make_mentor, device=EmulatedCtAnsi)
