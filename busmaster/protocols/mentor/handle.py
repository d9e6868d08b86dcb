"""The handle of a Mentor II drive."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, ClassVar, NamedTuple, Self, TypeVar, Unpack, overload

from busmaster.bus.handle import Handle, Send, encoder, item_text, unknown_item
from busmaster.bus.parameters import LAST, USUAL, Parameter, Value
from busmaster.bus.points import Point
from busmaster.bus.requester import CommandOptions, NodeSource, ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal, whole_number
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.mentor.codec import Read, ReadRun, Write, parse_parameter
from busmaster.protocols.mentor.parameters import NAMED, PARAMETERS, WIDE

T = TypeVar("T")

_BEYOND_ANY_FORM = 1e9
FINE = 10
"""Steps of the high resolution per ordinary step."""
MOST_DECIMALS = 9
NUMBERS = range(100)
"""The document has no list: any of these may be a parameter of a menu."""
STORE = 0
"""The number in each menu that is a command to the drive, such as to store its parameters."""
LARGEST_WITH_SIGN = 9999
FORM = "a parameter such as 1.17, 15.60:wide, 1.17:hires, 1.17:20 for a run of 20, or a name"


class Place(NamedTuple):
    """Menu and number of a parameter, and how many of its last digits are decimals; None: a value is the number."""

    menu: int
    number: int
    decimals: int | None

    def write(self, value: float, *, wide: bool, high_resolution: bool) -> Write:
        """Return the command that writes a value. Wide parameters of the guide are sent wide. Raises InvalidCommand."""
        decimals = self.decimals if self.decimals is None else self.decimals + high_resolution
        wide = wide or (not high_resolution and self[:2] in WIDE)
        return Write(self.menu, self.number, to_line(value, decimals), wide, high_resolution)


class ParameterHandle(Handle):
    """A handle of a drive whose parameters have a menu and a number. Each protocol defines the read commands.

    `decimals` is by parameter. Raises InvalidCommand for an invalid number of digits, or for two different ones of the
    same parameter.
    """

    _read_command: ClassVar[type[Read]] = Read
    _run_command: ClassVar[type[ReadRun]] = ReadRun
    _menus: ClassVar[range] = range(17)
    """The menus of the drives: Mentor II has 1 to 16, and 0 for the user. A read of a parameter that does not exist
    takes two exchanges and the maximum reply delay (R7), so the menus up to 99 would take an hour."""

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        decimals: Mapping[str, int] | None = None,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
        profile: Profile | None = None,
    ) -> None:
        super().__init__(bus, address, timings=timings, retries=retries, profile=profile)
        self._decimals: dict[tuple[int, int], int] = {}
        for text, digits in (decimals or {}).items():
            digits = whole_number(digits, 0, MOST_DECIMALS, f"the decimals of {text}")
            if (known := self._decimals.setdefault(self._place_of(text), digits)) != digits:
                raise InvalidCommand(f"{text} has {known} decimals by another name, not {digits}")

    @staticmethod
    def _place_of(text: str) -> tuple[int, int]:
        """Return menu and number of "1.17" or "01.17". Raises InvalidCommand for anything else."""
        return parse_parameter(text)

    def _values_of(self, run: ReadRun, sent: Sequence[Any]) -> tuple[float, ...]:
        """Return the values of a run that was read."""
        return tuple(sent)

    @overload
    async def read(self, item: str, **options: Unpack[ReadOptions]) -> float: ...

    @overload
    async def read(
        self, item: str, count: int, *, step: int = 1, chain: bool = False, **options: Unpack[ReadOptions]
    ) -> tuple[float, ...]: ...

    async def read(
        self,
        item: str,
        count: int | None = None,
        *,
        step: int = 1,
        chain: bool = False,
        **options: Unpack[ReadOptions],
    ) -> float | tuple[float, ...]:
        """Return a parameter's value, a bit as 0 or 1; with `count`, this many parameters of its menu from there on.

        `step` -1 reads the parameters before it instead of those after it, 0 the same one repeatedly. They are read one
        by one. With `chain` they take one exchange, with one request byte for each after the first. Use `chain` only if
        no other drive can interpret or send that byte. Every node of the line must then be a drive that forgets its
        last parameter when another drive is addressed. Raises NoSuchParameter, also if the menu has a gap, and
        InvalidCommand at address 0.
        """
        if count is None:
            if chain or step != 1:
                raise InvalidCommand(f"{self.node.label}: chain and step need a count of parameters")
            return await self._read_one(item, options)
        run = self._run_command(*self._place_of(item), count, step)
        if chain:
            return self._values_of(run, await self.node.request(run, **options))
        requests = SeveralRequests(self.node, options)
        return self._values_of(run, [await requests.request(self._read_command(*place)) for place in places_of(run)])

    async def _read_one(self, item: str, options: ReadOptions) -> float:
        return await self.node.request(self._read_command(*self._place_of(item)), **options)

    @classmethod
    def _known(cls) -> Mapping[tuple[int, int], Parameter]:
        """Return the parameters that a document describes, by menu and number."""
        return {}

    def _listed(self) -> Iterable[Parameter]:
        """Return all numbers of all menus: the drive replies to those that it does not have, and they are left out.

        The command of each menu is written last.
        """
        known = self._known()
        for place in ((menu, number) for menu in self._menus for number in NUMBERS):
            stage = LAST if place[1] == STORE else USUAL
            yield known.get(place) or Parameter(item=f"{place[0]}.{place[1]:02d}", stage=stage)

    def _plain(self) -> Self:
        if not self._decimals:
            return self
        plain = copy(self)
        plain._decimals = {}
        return plain

    async def _read_item(self, item: str, *, chain: bool = False, **options: Any) -> Any:
        """Read as `point(item).read()` does. Without `chain`, read a run parameter by parameter: always safe."""
        parameter, _, count = item_text(item).partition(":")
        if is_decimal(count) and not chain:
            return await self.read(parameter, int(count))
        return await self.point(item).read()


class MentorDrive(ParameterHandle):
    """A Mentor II drive: addresses 1-99, and 0 to write to all drives at once.

        drive = MentorDrive(bus, 14, decimals={"1.17": 1})
        await drive.write("1.17", -47.6)
        speed = await drive.read("1.17")

    The line carries whole numbers. `decimals`: number of decimals of a parameter. Its values are then in its own unit,
    rounded to these decimals; without an entry a value is the number on the line. A parameter with a name in the guide
    can be used by that name too, and then has the guide's decimals: `read("speed_reference_1")` is in %. With
    `chained`, poll groups read neighbouring parameters of this drive as runs, for all its handles: `read` states when
    that is safe. It must be set by the first handle of a drive.
    """

    profile: ClassVar[Profile] = mentor.PROFILE

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        decimals: Mapping[str, int] | None = None,
        chained: bool = False,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> None:
        profile = mentor.CHAINED if chained else mentor.PROFILE
        super().__init__(bus, address, decimals=decimals, timings=timings, retries=retries, profile=profile)
        if address and (address < 10 or address % 10 == 0):
            warnings.warn(
                "mentor: addresses below 10, and the tens, mean groups to later Control Techniques products: if some "
                "share the line, use 11 to 99 without the tens",  # the same text for each drive, so it is shown once
                stacklevel=2,
            )

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return tuple(NAMED)

    @classmethod
    def _names_of_items(cls) -> Mapping[str, str]:
        return {f"{parameter.menu:02d}.{parameter.number:02d}": name for name, parameter in NAMED.items()}

    def point(self, item: str) -> Point[Any]:
        """Return the point of a parameter or of a run.

        It is a parameter ("1.17", "speed_reference_1"), one written as a wide integer ("15.60:wide") or in high
        resolution ("1.17:hires"), or a run, always read in one exchange ("1.17:20").
        """
        text, colon, kind = item_text(item).partition(":")
        try:
            place = self._place(text)
        except InvalidCommand:
            raise unknown_item(item, NAMED, FORM) from None
        if is_decimal(kind):
            return self._run_point(item, ReadRun(place.menu, place.number, int(kind)))
        if kind not in ("wide", "hires") and colon:
            raise unknown_item(item, NAMED, FORM)
        unit = NAMED[text].unit if text in NAMED else ""
        return self._parameter_point(item, place, unit, wide=kind == "wide", high_resolution=kind == "hires")

    def _parameter_point(
        self, item: str, place: Place, unit: str, *, wide: bool, high_resolution: bool
    ) -> Point[float]:
        decimals = place.decimals

        def encode(value: float) -> Command[None]:
            return place.write(value, wide=wide, high_resolution=high_resolution)

        def decode(number: int) -> float:
            """Return it in the unit in which it is written: without decimals, high resolution counts in tenths."""
            return from_line(number * 10 if high_resolution and decimals is None else number, decimals)

        read = Read(place.menu, place.number)
        return ScaledPoint(self.node, item, read, unit=unit, decode=decode, encode=encode, decimals=(decimals,))

    def _run_point(self, item: str, run: ReadRun) -> Point[tuple[float, ...]]:
        decimals = tuple(self._decimals.get(parameter) for parameter in places_of(run))
        return ScaledPoint(self.node, item, run, decode=lambda sent: self._values_of(run, sent), decimals=decimals)

    @classmethod
    def _known(cls) -> Mapping[tuple[int, int], Parameter]:
        return {
            one.place: Parameter(
                item=f"{one.menu}.{one.number:02d}",
                name=one.name,
                unit=one.unit,
                access=one.access,
                decimals=one.decimals,
                kept=one.kept,
            )
            for one in PARAMETERS
        }

    @classmethod
    def _same(cls, item: str, one: Value, other: Value) -> bool:
        # A reply always has five characters, and so not the written tenths.
        return abs(one - other) < FINE if item.endswith(":hires") else one == other

    def _written_item(self, item: str, before: Value, value: Value) -> str:
        """Return the item as a wide one, if the value before or the new one has no other form."""
        return f"{item}:wide" if ":" not in item and max(before, value) > LARGEST_WITH_SIGN else item

    async def _read_one(self, item: str, options: ReadOptions) -> float:
        place = self._place(item)
        found = await self.node.request(Read(place.menu, place.number), **options)
        return from_line(found, place.decimals)

    async def write(
        self,
        item: str,
        *values: float,
        wide: bool = False,
        high_resolution: bool = False,
        **options: Unpack[WriteOptions],
    ) -> None:
        """Write a parameter, or several of a menu from `item` on, acknowledged; at address 0 to all drives, which do
        not reply.

        `wide` is for 16-bit integers; it is the default for those of the guide (13.14, 15.60 to 15.63). With
        `high_resolution` a value without declared decimals is in tenths of the unit of a read. `verify` reads back, and
        raises VerifyFailed if the value differs. Raises InvalidCommand, before anything is sent, for a value that does
        not fit.
        """
        names = self._names(item, values)
        commands = [
            self._place(name).write(value, wide=wide, high_resolution=high_resolution)
            for name, value in zip(names, values, strict=True)
        ]
        self.node.check(*commands, stop=options.get("safe"))
        requests = SeveralRequests(self.node, options)
        for command in commands:
            await requests.request(command)
        for name, command in zip(names, commands, strict=True) if requests.verify else ():
            check = Read(command.menu, command.number)
            found = await requests.read_back(check)
            # A reply always has five characters, and so not the written tenths.
            if abs(found * 10 - command.value) >= 10 if high_resolution else found != command.value:
                raise VerifyFailed(
                    f"{name} reads {found} after {command.text} was written", node=self.node, command=str(check)
                )

    async def write_all(
        self,
        parameter: str,
        value: float,
        *,
        wide: bool = False,
        high_resolution: bool = False,
        **options: Unpack[CommandOptions],
    ) -> None:
        """Write a parameter of every drive on the line at once (address 0). No drive replies."""
        command = self._place(parameter).write(value, wide=wide, high_resolution=high_resolution)
        await self.bus.node(mentor.PROFILE, 0).request(command, **options)

    def _prepare_one(self, item: str, value: Any, **options: Unpack[WriteOptions]) -> Send:
        self.node.check(encoder(self.point(item))(value), stop=options.get("safe"))
        parameter, _, kind = item.partition(":")
        return lambda: self.write(parameter, value, wide=kind == "wide", high_resolution=kind == "hires", **options)

    def _place(self, text: str) -> Place:
        """Return the place of a parameter, by number or name. A name has the guide's decimals by default."""
        where = self._place_of(text)
        decimals = NAMED[text].decimals if text in NAMED else 0
        return Place(*where, self._decimals.get(where, decimals or None))

    @staticmethod
    def _place_of(text: str) -> tuple[int, int]:
        """Return menu and number of "1.17", "01.17", or a name that the guide gives.

        Raises InvalidCommand for anything else.
        """
        named = NAMED.get(str(text))  # an argument that is not a text is rejected below
        return parse_parameter(text) if named is None else named.place

    def _values_of(self, run: ReadRun, sent: Sequence[Any]) -> tuple[float, ...]:
        return tuple(from_line(n, self._decimals.get(place)) for n, place in zip(sent, places_of(run), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaledPoint(Point[T]):
    """Points of one parameter are equal only if the handles that made them scale it alike."""

    decimals: tuple[int | None, ...]


def places_of(run: ReadRun) -> list[tuple[int, int]]:
    """Return the parameters of a run, each as menu and number."""
    return [(run.menu, run.number + run.step * i) for i in range(run.count)]


def to_line(value: float, decimals: int | None) -> int:
    """Return the whole number for a value, rounded half away from zero. True and False are unchanged.

    Raises InvalidCommand for a fraction if no decimals are declared, for NaN and infinity, and if it is not a number.
    """
    if isinstance(value, bool):
        return value
    # A text has no __float__. A NaN differs from itself; a Decimal NaN allows no other comparison.
    if not hasattr(value, "__float__") or value != value or not abs(value) < _BEYOND_ANY_FORM:
        raise InvalidCommand(f"{value!r} cannot be sent: a parameter has at most five digits")
    if decimals is None:
        if value != int(value):
            raise InvalidCommand(f"{value!r} is not a whole number, and the parameter has no declared decimals")
        return int(value)
    return int(Decimal(str(value)).scaleb(decimals).quantize(Decimal(1), ROUND_HALF_UP))


def from_line(number: int, decimals: int | None) -> float:
    """Return the value for a number on the line."""
    return number / 10**decimals if decimals else number
