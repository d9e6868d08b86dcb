"""The handle of an MSC controller."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NoReturn, Unpack, overload

from busmaster.bus.handle import Action, Handle, Send, checked_count, encoder, item_text, unknown_item
from busmaster.bus.parameters import Parameter
from busmaster.bus.points import Point
from busmaster.bus.requester import CommandOptions, NodeSource, Priority, ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, Refused, VerifyFailed
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.blocks import Count, Part, Progress, place, reads, reads_back, writes
from busmaster.protocols.msc.codec import (
    BLOCK,
    FLAGS,
    BlockRead,
    ClearFlag,
    DataRead,
    DataWrite,
    Merging,
    ReadFlag,
    ReadFlags,
    ReadStatus,
    SetFlag,
)
from busmaster.protocols.msc.status import ProgramStatus

MODELS_WITH_RFLAGS = frozenset({"MSC-250", "MSC-850/32"})
ADDRESS_STEPS = (1, 4)
"""The document does not define it: addresses may count values or bytes."""
FORM = "a data address or symbol, 2008:32 for a run of 32, flag:5, flags, or status"


class MscController(Handle):
    """An MSC controller: units 1-15. Data variables by address, or by name from `symbols`; flags; the program's status.

        press = MscController(bus, 3, symbols={"count": 2008, "cam": 3000}, address_step=4, model="MSC-250")
        count = await press.read("count")
        await press.load_cam("cam", table)
        if ProgramStatus.PROGRAM_RUNNING in await press.status(): ...

    `symbols`: the data table of the program's listing. `address_step`: difference of the addresses of two consecutive
    values. The document does not define it, so give it or call `find_address_step`. Until it is known, no more than one
    block of 32 values is transferred at once. Models "MSC-250" and "MSC-850/32" send all flags in one exchange. All
    handles of a unit share its step and its model; each handle has its own `symbols`.
    """

    profile: ClassVar[Profile] = msc.PROFILE

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        symbols: Mapping[str, int] | None = None,
        address_step: int | None = None,
        model: str | None = None,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> None:
        self.model = model
        self.symbols = dict(symbols or {})
        for name, symbol in self.symbols.items():
            DataRead(symbol)
            # It could not be distinguished from an item.
            if not name or name in self.items() or is_decimal(name) or set(name) & set(":=, "):
                raise InvalidCommand(f"{name!r} cannot be the name of a symbol")
        known = Merging(address_step, model in MODELS_WITH_RFLAGS)
        # A handle without these options keeps those of another handle of this unit: a wrong step gives wrong values.
        profile = self.profile if known == Merging() else replace(self.profile, merge=known)
        super().__init__(bus, address, timings=timings, retries=retries, profile=profile)

    @property
    def address_step(self) -> int | None:
        """Difference of the addresses of two consecutive values, for all handles of this unit; None: not known yet."""
        return self._merging.address_step

    @address_step.setter
    def address_step(self, step: int) -> None:
        self.node.merge_reads(replace(self._merging, address_step=step))

    # points

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return ("flags", "status")

    def point(self, item: str) -> Point[Any]:
        """Return the point of a value ("2008" or a symbol), a run ("2008:32"), "flag:5", "flags" or "status"."""
        if item_text(item) == "status":
            # A line that another program owns brings the number alone.
            return Point(self.node, item, ReadStatus(), decode=ProgramStatus)
        if item == "flags":
            return Point(self.node, item, ReadFlags())
        name, colon, number = item.partition(":")
        if colon and not is_decimal(number):
            raise unknown_item(item, (*self.items(), *self.symbols), FORM)
        if name == "flag" and colon:
            return self._flag_point(int(number))
        if name not in self.symbols and not is_decimal(name):
            raise unknown_item(item, (*self.items(), *self.symbols), FORM)
        address = self._address_of(name)
        if colon:
            return Run.of(self, item, address, int(number))
        return Point(self.node, item, DataRead(address), encode=lambda value: DataWrite(address, value))

    def _flag_point(self, flag: int) -> Point[bool]:
        def encode(on: bool) -> Command[None]:
            if on not in (0, 1):
                raise InvalidCommand(f"a flag is written 1 or 0, not {on!r}")
            return SetFlag(flag) if on else ClearFlag(flag)

        return Point(self.node, f"flag:{flag}", ReadFlag(flag), encode=encode)

    def _run_items(self, item: str, count: int) -> tuple[str, ...]:
        """Return the item of each value of a run: its address, or if it is unknown, the run's with a number."""
        name = item.partition(":")[0]
        if self.address_step is None:
            return tuple(f"{name}[{i}]" for i in range(count))
        address = self._address_of(name)
        return tuple(str(address + i * self.address_step) for i in range(count))

    async def _read_item(self, item: str, **options: Any) -> Any:
        """Read as `point(item).read()` does. Flags of a model without RFLAGS are read one by one."""
        try:
            return await self.point(item).read()
        except Refused:
            if item != "flags":
                raise
            return await self.flags()

    def _prepare_write(self, item: str, values: Sequence[Any], **options: Unpack[WriteOptions]) -> list[Send]:
        """Prepare to write consecutive data addresses, in blocks and one by one."""
        point = self.point(item)
        if isinstance(point, Run):
            point.check_length(values)
        elif len(values) == 1:
            return super()._prepare_write(item, values, **options)
        name = item.partition(":")[0]
        encoder(self.point(name))
        parts = writes(self._address_of(name), values, self.address_step)
        self.node.check(*(command for command, _ in parts), stop=options.get("safe"))
        return [lambda: self.write_block(name, values, **options)]

    def _address_of(self, where: int | str) -> int:
        """Return the data address of a symbol, or an address as it is. Raises InvalidCommand for no such symbol."""
        if not isinstance(where, str):
            return where
        if where in self.symbols:
            return self.symbols[where]
        if not is_decimal(where):
            raise unknown_item(where, self.symbols, "a data address or a symbol of this controller's program")
        return int(where)

    # values

    @overload
    async def read(self, item: int | str, **options: Unpack[ReadOptions]) -> int: ...

    @overload
    async def read(self, item: int | str, count: int, **options: Unpack[ReadOptions]) -> tuple[int, ...]: ...

    async def read(
        self, item: int | str, count: int | None = None, **options: Unpack[ReadOptions]
    ) -> int | tuple[int, ...]:
        """Return the value at a data address or symbol; with `count`, a tuple of this many, 32 per exchange.

        More than 32 values are not all of one moment. If the last 32 would reach beyond the data area and are
        refused, the values are read one by one. Raises Refused for an address outside the data area, and InvalidCommand
        for more than 32 while the address step is unknown. `start_within` applies to each exchange.
        """
        address = self._address_of(item)
        if count is None:
            return await self.node.request(DataRead(address), **options)
        values: list[int] = []
        requests = SeveralRequests(self.node, options)
        for part in reads(address, checked_count(count), self.address_step):
            values += await self._read_part(part, requests.request)
        return tuple(values)

    async def write(self, item: int | str, *values: int, **options: Unpack[WriteOptions]) -> None:
        """Write a value, or consecutive values, acknowledged: `write_block` without its progress.

        `verify` reads it back, and raises VerifyFailed if it differs. `idempotent` allows a retry after an unknown
        outcome; do not use it if the program consumes written values. Raises InvalidCommand, before anything is sent,
        for a value that is not a signed 32-bit number.
        """
        if not values:
            raise InvalidCommand(f"{self.node.label}: there is no value to write to {item}")
        await self.write_block(item, values, **options)

    async def write_block(
        self,
        item: int | str,
        values: Iterable[int],
        *,
        progress: Progress | None = None,
        **options: Unpack[WriteOptions],
    ) -> None:
        """Write consecutive values: whole blocks of 32, and the rest one by one, so that no other value changes.

        If one exchange fails, the values before it are stored. `verify` reads all values back after all are written,
        and raises VerifyFailed at the first difference. `progress` is called after each exchange with the number of
        transferred values and their total; values to be verified count twice. Raises InvalidCommand, before anything is
        sent, for a value that is not a signed 32-bit number, and for more than one exchange while the address step is
        unknown.
        """
        address = self._address_of(item)
        wanted = tuple(values)
        requests = SeveralRequests(self.node, options)
        done = Count(progress, len(wanted) * (1 + requests.verify))
        parts = writes(address, wanted, self.address_step)
        self.node.check(*(command for command, _ in parts), stop=options.get("safe"))
        for command, size in parts:
            await requests.request(command)
            done.add(size)
        if requests.verify:
            await self._verify(address, wanted, requests, done)

    async def load_cam(
        self,
        item: int | str,
        values: Iterable[int],
        *,
        progress: Progress | None = None,
        **options: Unpack[ReadOptions],
    ) -> None:
        """Write a CAM table and verify it: `write_block` in the background of other traffic, repeated if uncertain.

        Load it while the program does not use it. If this raises, part of the table is stored: load it again.
        """
        if options.get("priority") is None:
            options["priority"] = Priority.BACKGROUND
        # The program does not use the table in the meantime, so it cannot consume a value that is written twice.
        await self.write_block(item, values, progress=progress, verify=True, idempotent=True, **options)

    async def find_address_step(self, item: int | str) -> int:
        """Find the difference of the addresses of two consecutive values, and store it in `address_step`.

        `item`: the first of a few values that differ and do not change in the meantime. A block read from there is
        compared with single reads. Raises InvalidCommand if they do not show it; then give the step.
        """
        address = self._address_of(item)
        block = await self.node.request(BlockRead(address))
        found = {step: await self._value_or_none(address + step) for step in ADDRESS_STEPS}
        bytewise = found[4] == block[1]
        valuewise = found[1] == block[1] and found[4] == block[4]
        if bytewise == valuewise:  # equal values fit both steps, changing ones neither
            raise InvalidCommand(
                f"{self.node.label}: the values from {address} on do not show the address step: "
                "use values that differ, or give address_step"
            )
        step = 4 if bytewise else 1
        self.address_step = step
        return step

    # flags and status

    async def flag(self, number: int, **options: Unpack[ReadOptions]) -> bool:
        """Return whether a flag (input, output, timer, motor status or user flag), 0 to 255, is on."""
        return await self.node.request(ReadFlag(number), **options)

    async def set_flag(self, number: int, **options: Unpack[CommandOptions]) -> None:
        """Turn an output flag or user flag on. Raises Refused for another."""
        await self.node.request(SetFlag(number), **options)

    async def clear_flag(self, number: int, **options: Unpack[CommandOptions]) -> None:
        """Turn an output flag or user flag off. Raises Refused for another."""
        await self.node.request(ClearFlag(number), **options)

    async def flags(self, **options: Unpack[ReadOptions]) -> frozenset[int]:
        """Return the flags that are on: in one exchange if the model supports it, else in 256."""
        if self._merging.all_flags:
            return await self.node.request(ReadFlags(), **options)
        requests = SeveralRequests(self.node, options)
        return frozenset([flag for flag in range(FLAGS) if await requests.request(ReadFlag(flag))])

    async def status(self, **options: Unpack[ReadOptions]) -> ProgramStatus:
        """Return the macroprogram status word."""
        return ProgramStatus(await self.node.request(ReadStatus(), **options))

    async def in_operation(self, **options: Unpack[ReadOptions]) -> str | None:
        """Return that the program runs, which uses the data, from its status word; "" if it does not."""
        running = ProgramStatus.PROGRAM_RUNNING in await self.status(**options)
        return "PROGRAM_RUNNING is set in its status word" if running else ""

    _actions: ClassVar[Mapping[str, Action]] = {
        "set-flag": Action(
            "Turn an output flag or user flag on.",
            set_flag,
            check=lambda unit, number: unit.node.check(SetFlag(number)),
            numbers=("FLAG",),
        ),
        "clear-flag": Action(
            "Turn an output flag or user flag off.",
            clear_flag,
            check=lambda unit, number: unit.node.check(ClearFlag(number)),
            numbers=("FLAG",),
        ),
    }

    # inside

    def _listed(self) -> Iterable[Parameter]:
        """Return the symbols of the program, by their addresses: the document lists no data."""
        names = {address: name for name, address in self.symbols.items()}
        return (Parameter(item=str(address), name=names[address]) for address in sorted(names))

    @property
    def _merging(self) -> Merging:
        """The step and the model of the unit, from any of its handles."""
        merge = self.node.profile.merge
        return merge if isinstance(merge, Merging) else Merging()

    async def _read_part(self, part: Part, ask: Callable[[Command[Any]], Awaitable[Any]]) -> tuple[int, ...]:
        step = self.address_step
        try:
            found = await ask(part.command)
        except Refused:
            if part.size in (1, BLOCK) or step is None:
                raise
            # the block may reach beyond the data area where its first values do not
            places = [place(part.at, i, step) for i in range(part.size)]
            return tuple([await ask(DataRead(at)) for at in places])
        return found[: part.size] if isinstance(found, tuple) else (found,)

    async def _verify(self, address: int, wanted: Sequence[int], requests: SeveralRequests, done: Count) -> None:
        index = 0
        for part in reads_back(address, len(wanted), self.address_step):
            for found in await self._read_part(part, requests.read_back):
                if found != wanted[index]:
                    raise VerifyFailed(
                        f"value {index} from data {address} on reads {found} after {wanted[index]} was written",
                        node=self.node,
                    )
                index += 1
            done.add(part.size)

    async def _value_or_none(self, address: int) -> int | None:
        try:
            return await self.read(address)
        except Refused:
            return None


@dataclass(frozen=True, slots=True)
class LongRun:
    """Stands for a run of more than one block, which is more than one exchange and cannot be polled."""

    address: int
    count: int

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __str__(self) -> str:
        return f"read {self.count} values from data {self.address}"

    def open(self, address: int, timings: Timings, /) -> NoReturn:
        """Raise InvalidCommand: only a point of one block at most can be polled."""
        raise InvalidCommand(f"a point that is polled has at most {BLOCK} values, not {self.count}: poll several")


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(Point[tuple[int, ...]]):
    """Consecutive values as one point, of any length. One block of 32 at most can be polled."""

    handle: MscController = field(compare=False)
    address: int
    count: int

    @classmethod
    def of(cls, handle: MscController, item: str, address: int, count: int) -> Run:
        """Return a run as a point. Raises InvalidCommand for more than one block while the address step is unknown."""
        reads(address, count, handle.address_step)
        command = BlockRead(address) if count <= BLOCK else LongRun(address, count)
        return cls(
            node=handle.node,
            item=item,
            command=command,
            decode=lambda block: block[:count],
            handle=handle,
            address=address,
            count=count,
        )

    @property
    def writable(self) -> bool:
        return True

    async def read(self, *, max_age: float | None = None, **options: Unpack[ReadOptions]) -> tuple[int, ...]:
        """Do as `Point.read` does, or as `MscController.read` where it is longer than a block."""
        if self.count <= BLOCK:
            return await Point.read(self, max_age=max_age, **options)
        return await self.handle.read(self.address, self.count, **options)

    async def write(self, value: Sequence[int], **options: Unpack[WriteOptions]) -> None:
        """Do as `MscController.write_block` does.

        Raises InvalidCommand unless there are as many values as in the run.
        """
        self.check_length(value)
        await self.handle.write_block(self.address, value, **options)

    def check_length(self, values: Any) -> None:
        """Raise InvalidCommand unless there are as many values as in the run."""
        count = len(values) if isinstance(values, Sized) else None
        if count != self.count:
            given = repr(values) if count is None else count
            raise InvalidCommand(f"{self.node.label}: {self.item} takes {self.count} values, not {given}")
