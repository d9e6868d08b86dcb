"""The handle of an instrument with EI-Bisynch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, ClassVar, Self, Unpack

from busmaster.bus.handle import Action, Handle, Send, encoder, item_text, unknown_item
from busmaster.bus.parameters import FIRST, USUAL, Parameter
from busmaster.bus.points import Point
from busmaster.bus.requester import CommandOptions, NodeSource, ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal, whole_number
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, InvalidCommand, Refused, VerifyFailed
from busmaster.protocols.ei_bisynch.codec import (
    LONGEST_DATA,
    PRINTABLE,
    PROFILE,
    Read,
    ReadRun,
    Write,
    check_name,
    is_sendable,
)
from busmaster.protocols.ei_bisynch.parameters import (
    LAST_ERROR,
    MANUAL,
    NAMED,
    PARAMETERS,
    TAG,
    error_text,
    mnemonic_of_tag,
)

FORM = "a mnemonic such as PV, 1PV of channel 1, tag247, SW:hex to write hexadecimal, PV,SL,OP as one run, or a name"
HEX = ":hex"
MOST_DECIMALS = 9


class BisynchInstrument(Handle):
    """An instrument with EI-Bisynch, at the addresses 0 to 99: its group and its unit, a digit each.

        furnace = BisynchInstrument(bus, 1, decimals={"SL": 1})
        await furnace.write("SL", 450.0)
        temperature = await furnace.read("PV")

    The instrument sends decimal points itself. `decimals`: number of digits to which a parameter's values are rounded
    before they are written, half away from zero; without an entry a value is sent unchanged. `fixed_width`: for
    instruments with the fixed format, the number of characters to which numbers are filled with zeros.
    `printable_check`: for instruments that add 32 to a BCC below 32. The error of a refused write contains the
    instrument's own reason, which is read from the mnemonic EE.
    """

    profile: ClassVar[Profile] = PROFILE
    _identity = ("II", "V0")

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        decimals: Mapping[str, int] | None = None,
        fixed_width: int | None = None,
        printable_check: bool = False,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> None:
        profile = PRINTABLE if printable_check else PROFILE
        super().__init__(bus, address, timings=timings, retries=retries, profile=profile)
        self._printable_check = printable_check
        self._width = 0 if fixed_width is None else whole_number(fixed_width, 1, LONGEST_DATA, "fixed_width")
        self._decimals = {
            name_of(name): whole_number(digits, 0, MOST_DECIMALS, f"the decimals of {name}")
            for name, digits in (decimals or {}).items()
        }

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return tuple(NAMED)

    @classmethod
    def _names_of_items(cls) -> Mapping[str, str]:
        return {name_of(parameter.item): name for name, parameter in NAMED.items()}

    def point(self, item: str) -> Point[Any]:
        """Return the point of a parameter ("process_value", "PV", "1PV", "tag247", "SW:hex"), or of a run that is
        always read in one exchange ("PV,SL,OP")."""
        text = item_text(item)
        try:
            if "," in text:
                return Point(self.node, item, self._run(text))
            name = name_of(text.removesuffix(HEX))
        except InvalidCommand:
            raise unknown_item(item, NAMED, FORM) from None
        named = NAMED.get(text)
        if named is not None and named.access == "read":
            return Point(self.node, item, self._read(name), unit=named.unit)
        unit = named.unit if named is not None else ""
        return Point(self.node, item, self._read(name), unit=unit, encode=lambda value: self._write(text, value))

    async def _read_item(self, item: str, *, chain: bool = False, **options: Any) -> Any:
        """Read a run parameter by parameter, which is always safe, unless `chain` is set."""
        if "," not in item_text(item) or chain:
            return await self.point(item).read()
        points = [self.point(name) for name in item.split(",")]
        return tuple([await point.read() for point in points])

    async def last_error(self, **options: Unpack[ReadOptions]) -> str:
        """Return the last error of the instrument: its code, and the text from the documents."""
        return error_text(await self.node.request(self._read(LAST_ERROR), **options))

    async def clear_error(self, **options: Unpack[CommandOptions]) -> None:
        """Clear the last error, so that the next one can be recognised."""
        await self.node.request(self._clearing(), **options)

    def _clearing(self) -> Write:
        return Write(LAST_ERROR, 0, hexadecimal=True, printable_check=self._printable_check)

    _actions: ClassVar[Mapping[str, Action]] = {
        "clear-error": Action(
            "Clear the last error, so that the next one can be recognised.",
            clear_error,
            check=lambda instrument: instrument.node.check(instrument._clearing()),
        )
    }

    async def write(self, item: str, *values: float, **options: Unpack[WriteOptions]) -> None:
        """Write a parameter, or several tags from `item` on, acknowledged.

        `verify` reads back, and raises VerifyFailed if the value differs. Raises InvalidCommand, before anything is
        sent, for a value that does not fit, and Refused with the instrument's own reason.
        """
        names = self._names(item, values)
        commands = [self._write(name, value) for name, value in zip(names, values, strict=True)]
        self.node.check(*commands, stop=options.get("safe"))
        requests = SeveralRequests(self.node, options)
        for command in commands:
            try:
                await requests.request(command)
            except Refused as refusal:
                raise await self._explained(refusal, requests, command) from refusal
        for name, command in zip(names, commands, strict=True) if requests.verify else ():
            found = await requests.read_back(self._read(command.name))
            if found != command.number:
                raise VerifyFailed(
                    f"{name} reads {found} after {command.text} was written", node=self.node, command=str(command)
                )

    async def _explained(self, refusal: Refused, requests: SeveralRequests, command: Write) -> Refused:
        """Return the refusal with the reason from EE; unchanged if EE cannot be read."""
        try:
            code = await requests.read_back(self._read(LAST_ERROR))
        except BusError:
            return refusal
        return Refused(
            f"refused, last error {error_text(code)}",
            confirm=False,
            node=self.node,
            command=str(command),
            attempts=refusal.attempts,
        )

    def _prepare_one(self, item: str, value: Any, **options: Unpack[WriteOptions]) -> Send:
        self.node.check(encoder(self.point(item))(value), stop=options.get("safe"))
        return lambda: self.write(item, value, **options)

    def _run_items(self, item: str, count: int) -> tuple[str, ...]:
        """Return the items of `count` values from a tag on. The order of mnemonics is not documented."""
        first, colon, kind = item_text(item).partition(":")
        number = first.removeprefix(TAG)
        if number == first or not is_decimal(number):
            raise InvalidCommand(f"several values begin at a tag, such as tag247, not at {item!r}")
        return tuple(f"{TAG}{int(number) + i}{colon}{kind}" for i in range(count))

    def _listed(self) -> Iterable[Parameter]:
        """Return the parameters of the documents, of which an instrument has some. The mode is written first."""
        for one in PARAMETERS:
            yield Parameter(
                item=one.item,
                name=one.name,
                unit=one.unit,
                access=one.access,
                kept=one.kept,
                stage=FIRST if one is MANUAL else USUAL,
            )

    def _plain(self) -> Self:
        plain = copy(self)
        plain._decimals = {}
        return plain

    def _read(self, name: str) -> Read:
        return Read(name, self._printable_check)

    def _run(self, text: str) -> ReadRun:
        return ReadRun(tuple(map(name_of, text.split(","))), self._printable_check)

    def _write(self, item: str, value: float) -> Write:
        name = name_of(item.removesuffix(HEX))
        hexadecimal = item.endswith(HEX) or (item in NAMED and NAMED[item].hexadecimal)
        digits = self._decimals.get(name)
        # A value that cannot be sent is refused by the command; True and False are not rounded.
        if digits is not None and is_sendable(value) and not isinstance(value, bool):
            value = float(Decimal(str(value)).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP))
        return Write(name, value, hexadecimal, 0 if hexadecimal else self._width, self._printable_check)


def name_of(item: str) -> str:
    """Return the name that is sent for "process_value", "PV", "1PV" or "tag247". Raises InvalidCommand for others."""
    text = item_text(item)
    if text in NAMED:
        text = NAMED[text].item
    number = text.removeprefix(TAG)
    if number != text and is_decimal(number):
        return mnemonic_of_tag(int(number))
    check_name(text)
    return text
