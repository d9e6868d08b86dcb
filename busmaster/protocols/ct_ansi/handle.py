"""The handle of a drive with CT-ANSI and decimal points."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, ClassVar, Unpack

from busmaster.bus.handle import Send, encoder, item_text, unknown_item
from busmaster.bus.parameters import Parameter
from busmaster.bus.points import Point
from busmaster.bus.requester import SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal
from busmaster.contract.profile import Profile
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.ct_ansi.codec import PROFILE, Read, ReadRun, Write, is_sendable
from busmaster.protocols.mentor.handle import ParameterHandle

REACHED_BY = {(11, 23): "serial address", (11, 24): "serial mode", (11, 25): "baud rate"}
"""Of Unidrive and Commander."""
FORM = "a parameter such as 1.21, or 1.21:8 for a run of 8"


class CtAnsiDrive(ParameterHandle):
    """A drive with CT-ANSI: addresses 11-99 without the tens, and 0 to write to all drives at once.

        drive = CtAnsiDrive(bus, 12, decimals={"1.21": 1})
        await drive.write("1.21", -47.6)
        speed = await drive.read("1.21")

    The drive sends decimal points itself. `decimals`: number of digits to which a parameter's values are rounded before
    they are written, half away from zero. Without an entry a value is sent unchanged. If it has more decimals than fit
    into twelve characters, it is rounded to those that fit, and a warning is logged.
    """

    profile: ClassVar[Profile] = PROFILE
    _read_command = Read
    _run_command = ReadRun
    _menus = range(23)

    def point(self, item: str) -> Point[Any]:
        """Return the point of a parameter ("1.21"), or of a run, always read in one exchange ("1.21:8")."""
        text, colon, count = item_text(item).partition(":")
        try:
            menu, number = self._place_of(text)
        except InvalidCommand:
            raise unknown_item(item, (), FORM) from None
        if not colon:
            return Point(self.node, item, Read(menu, number), encode=lambda value: self._write(menu, number, value))
        if not is_decimal(count):
            raise unknown_item(item, (), FORM)
        return Point(self.node, item, ReadRun(menu, number, int(count)))

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return ()

    async def write(self, item: str, *values: float, **options: Unpack[WriteOptions]) -> None:
        """Write a parameter, or several of a menu from `item` on, acknowledged; at address 0 to all drives, which do
        not reply.

        `verify` reads back, and raises VerifyFailed if the value differs. Raises InvalidCommand, before anything is
        sent, for a value that does not fit.
        """
        names = self._names(item, values)
        places = [self._place_of(name) for name in names]
        commands = [self._write(*place, value) for place, value in zip(places, values, strict=True)]
        self.node.check(*commands, stop=options.get("safe"))
        requests = SeveralRequests(self.node, options)
        for command in commands:
            await requests.request(command)
        for name, place, command in zip(names, places, commands, strict=True) if requests.verify else ():
            check = Read(*place)
            found = await requests.read_back(check)
            if found != float(command.text):
                raise VerifyFailed(
                    f"{name} reads {found} after {command.text} was written", node=self.node, command=str(check)
                )

    @classmethod
    def _known(cls) -> Mapping[tuple[int, int], Parameter]:
        return {
            place: Parameter(item=f"{place[0]}.{place[1]:02d}", kept=f"the drive is reached by it: {what}")
            for place, what in REACHED_BY.items()
        }

    def _prepare_one(self, item: str, value: Any, **options: Unpack[WriteOptions]) -> Send:
        self.node.check(encoder(self.point(item))(value), stop=options.get("safe"))
        return lambda: self.write(item, value, **options)

    def _write(self, menu: int, number: int, value: float) -> Write:
        digits = self._decimals.get((menu, number))
        # A value that cannot be sent is rejected by the command below; a bit is not rounded.
        if digits is not None and is_sendable(value) and not isinstance(value, bool):
            value = float(Decimal(str(value)).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP))
        return Write(menu, number, value)
