"""The handle of a drive that speaks CT-ANSI with decimal points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, ClassVar, Unpack

from busmaster.bus.handle import Handle, Send, encoder, item_text, unknown_item
from busmaster.bus.points import Point
from busmaster.bus.requester import NodeSource, ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.ct_ansi.codec import PROFILE, Read, ReadRun, Write
from busmaster.protocols.mentor.codec import parse_parameter

FORM = "a parameter such as 1.21, or 1.21:8 for a run of 8"


class CtAnsiDrive(Handle):
    """A drive with CT-ANSI: addresses 11-99 without the tens, and 0 to write to all drives at once.

        drive = CtAnsiDrive(bus, 12, decimals={"1.21": 1})
        await drive.write("1.21", -47.6)
        speed = await drive.read("1.21")

    The drive sends decimal points itself. `decimals` says to how many digits a parameter's values are rounded before
    they are written, half away from zero; without an entry a value is sent as it is.
    """

    profile: ClassVar[Profile] = PROFILE

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        decimals: Mapping[str, int] | None = None,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> None:
        super().__init__(bus, address, timings=timings, retries=retries)
        self._decimals = {parse_parameter(text): digits for text, digits in (decimals or {}).items()}

    def point(self, item: str) -> Point[Any]:
        """Return the point of a parameter ("1.21"), or of a run, always read in one exchange ("1.21:8")."""
        text, colon, count = item_text(item).partition(":")
        try:
            menu, number = parse_parameter(text)
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

    async def read(self, parameter: str, **options: Unpack[ReadOptions]) -> float:
        """Return a parameter's value. Raises NoSuchParameter, or InvalidCommand at address 0."""
        return await self.node.request(Read(*parse_parameter(parameter)), **options)

    async def read_run(
        self, parameter: str, count: int, *, step: int = 1, chain: bool = False, **options: Unpack[ReadOptions]
    ) -> tuple[float, ...]:
        """Return `count` parameters of a menu, from `parameter` on: the next ones, or with `step` -1 the previous ones.

        `step` 0 reads the same one again and again. With `chain` it takes one exchange, where that is safe: where no
        other drive can take or send a lone ACK, NAK or BS for its own. Raises NoSuchParameter where the menu has a gap.
        """
        run = ReadRun(*parse_parameter(parameter), count, step)
        if chain:
            return await self.node.request(run, **options)
        requests = SeveralRequests(self.node, options)
        return tuple([await requests.request(Read(run.menu, run.number + step * i)) for i in range(count)])

    async def write(self, parameter: str, value: float, **options: Unpack[WriteOptions]) -> None:
        """Write a parameter, acknowledged; at address 0 to all drives, which do not answer.

        `verify` reads back, and raises VerifyFailed if the value differs. Raises InvalidCommand, before anything is
        sent, for a value that does not fit.
        """
        menu, number = parse_parameter(parameter)
        command = self._write(menu, number, value)
        requests = SeveralRequests(self.node, options)
        await requests.request(command)
        if requests.verify:
            check = Read(menu, number)
            found = await requests.read_back(check)
            if found != float(command.text):
                raise VerifyFailed(
                    f"{parameter} reads {found} after {command.text} was written", node=self.node, command=str(check)
                )

    async def read_item(self, item: str, *, chain: bool = False, **options: Any) -> Any:
        """Do as `point(item).read()` does; read a run without `chain` parameter by parameter, which is always safe."""
        parameter, _, count = item_text(item).partition(":")
        if is_decimal(count) and not chain:
            return await self.read_run(parameter, int(count))
        return await self.point(item).read()

    def prepare_one(self, item: str, value: Any, **options: Unpack[WriteOptions]) -> Send:
        self.node.check(encoder(self.point(item))(value), stop=options.get("safe"))
        return lambda: self.write(item, value, **options)

    def _write(self, menu: int, number: int, value: float) -> Write:
        digits = self._decimals.get((menu, number))
        if digits is not None and math.isfinite(value) and not isinstance(value, bool):
            value = float(Decimal(str(value)).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP))
        return Write(menu, number, value)
