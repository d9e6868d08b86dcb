"""The handle of a DC104-SER drive."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, Unpack, overload

from busmaster.bus.handle import Handle, Send, checked_count, encoder, item_text, read_each, unknown_item
from busmaster.bus.parameters import Parameter
from busmaster.bus.points import Point
from busmaster.bus.requester import NodeSource, ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.dc104.codec import Read, Write


class Dc104Drive(Handle):
    """The only drive of its line: parameters 1 to `maximum`, each 0 to 65535. Their meaning is not published.

        drive = Dc104Drive(bus)
        await drive.write(12, 1500)
        value = await drive.read(12)

    `allow_zero` permits requests for parameter 0, which the document's own routines never send.
    """

    profile: ClassVar[Profile] = dc104.PROFILE

    def __init__(
        self,
        bus: NodeSource,
        address: int = 0,
        *,
        maximum: int = dc104.HIGHEST_PARAMETER,
        allow_zero: bool = False,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> None:
        super().__init__(bus, address, timings=timings, retries=retries)
        self._maximum = maximum
        self._minimum = 0 if allow_zero else 1
        self._read(maximum)

    def point(self, item: str) -> Point[int]:
        """Return the point of a parameter, by its number, decimal."""
        if not is_decimal(item_text(item)):
            raise unknown_item(item, (), f"a parameter number, {self._minimum} to {self._maximum}")
        return self.parameter(int(item))

    def parameter(self, number: int) -> Point[int]:
        """Return a parameter as a point. Raises InvalidCommand for one that the drive does not have."""

        def encode(value: int) -> Command[None]:
            return self._write(number, value)

        return Point(self.node, str(number), self._read(number), encode=encode)

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return ()

    @overload
    async def read(self, item: int, **options: Unpack[ReadOptions]) -> int: ...

    @overload
    async def read(self, item: int, count: int, **options: Unpack[ReadOptions]) -> tuple[int, ...]: ...

    async def read(self, item: int, count: int | None = None, **options: Unpack[ReadOptions]) -> int | tuple[int, ...]:
        """Return a parameter's value; with `count`, a tuple of this many from there on, read one by one.

        Raises Refused if the drive replies with a NAK.
        """
        if count is None:
            return await self.node.request(self._read(item), **options)
        commands = [self._read(one) for one in range(item, item + checked_count(count))]
        return await read_each(self.node, commands, options)

    async def write(self, item: int, *values: int, **options: Unpack[WriteOptions]) -> None:
        """Write a parameter, or several from `item` on: each acknowledged when the drive has completed it.

        `verify` reads it back, and raises VerifyFailed if it differs. `idempotent` allows a retry after an unknown
        outcome. Raises InvalidCommand, before anything is sent, for a value that is not 0 to 65535.
        """
        if not values:
            raise InvalidCommand(f"{self.node.label}: there is no value to write to {item}")
        commands = [self._write(item + offset, value) for offset, value in enumerate(values)]
        self.node.check(*commands, stop=options.get("safe"))
        requests = SeveralRequests(self.node, options)
        for command in commands:
            await requests.request(command)
        for command in commands if requests.verify else ():
            found = await requests.read_back(self._read(command.parameter))
            if found != command.value:
                raise VerifyFailed(
                    f"parameter {command.parameter} reads {found} after {command.value} was written", node=self.node
                )

    def _prepare_one(self, item: str, value: Any, **options: Unpack[WriteOptions]) -> Send:
        self.node.check(encoder(self.point(item))(value), stop=options.get("safe"))
        return lambda: self.write(int(item), value, **options)

    def _listed(self) -> Iterable[Parameter]:
        """Return every number that the drive can have: their meaning is not published."""
        return (Parameter(item=str(number)) for number in range(self._minimum, self._maximum + 1))

    def _read(self, parameter: int) -> Read:
        return Read(parameter, self._maximum, self._minimum)

    def _write(self, parameter: int, value: int) -> Write:
        return Write(parameter, value, self._maximum, self._minimum)
