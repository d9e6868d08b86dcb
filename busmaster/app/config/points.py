"""The points of a file: what the protocol has, under a name, in a unit, on a scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Unpack, cast

from busmaster import InvalidCommand, Meaning, Point
from busmaster.ext import PLAIN, Command, CommandOptions


@dataclass(frozen=True, slots=True)
class Scale:
    """What a number on the line means: value = number / 10**decimals x factor + offset.

    Calculated in whole numbers and divided once, so that 3 x 0.1 is 0.3; of a number with decimals 15 digits are kept,
    so that 14.2953 x 0.001 is 0.0142953. `whole`: the line carries whole numbers, to which a written value is rounded,
    half away from zero.
    """

    factor: Fraction
    offset: Fraction
    whole: bool

    @classmethod
    def of(cls, factor: float = 1, offset: float = 0, decimals: int = 0, whole: bool = False) -> Scale:
        """Return the scale of these numbers, kept exactly as they are written.

        Raises InvalidCommand for a factor of 0.
        """
        if not factor:
            raise InvalidCommand("a factor must not be 0, because every value would be the same")
        return cls(Fraction(repr(factor)) / 10**decimals, Fraction(repr(offset)), whole)  # repr: 0.1 is a tenth

    @property
    def trivial(self) -> bool:
        return self.factor == 1 and not self.offset

    def reader(self) -> Callable[[Any], Any]:
        """Return a function from the line's number to the value.

        Words, flags and texts are left as they are; of a run every number is scaled.
        """
        below = self.factor.denominator * self.offset.denominator
        times = self.factor.numerator * self.offset.denominator
        plus = self.offset.numerator * self.factor.denominator

        def read(number: Any) -> Any:
            if type(number) is int:  # not isinstance: a word or a flag is an int, too, and keeps its type
                return (number * times + plus) / below
            if type(number) is float:
                return float(f"{(number * times + plus) / below:.15g}")
            return tuple(map(read, number)) if type(number) is tuple else number

        return read

    def write(self, value: Any) -> Any:
        """Return the line's number, or run of numbers, for a value.

        Raises InvalidCommand for one that is too large, and for true and false where the scale makes another number.
        """
        if isinstance(value, list | tuple):
            return tuple(map(self.write, value))
        if type(value) is int or (type(value) is float and math.isfinite(value)):  # inf is the protocol's to refuse
            exact = (Fraction(repr(value)) - self.offset) / self.factor
            try:
                return rounded(exact) if self.whole else float(exact)
            except OverflowError:
                raise InvalidCommand(f"{value!r} is too large") from None
        if isinstance(value, bool) and not self.trivial:
            raise InvalidCommand(f"{value!r} is not a number; write {int(value)} for the number")
        return value


def rounded(number: Fraction) -> int:
    """Round half away from zero."""
    magnitude = (2 * abs(number.numerator) + number.denominator) // (2 * number.denominator)
    return magnitude if number >= 0 else -magnitude


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedPoint(Point[Any]):
    """A point under the file's names for its node and itself. `source` is the protocol's own.

    `declared`: whether the file lets it be written, where the protocol does.
    """

    where: str = field(compare=False)
    source: Point[Any] = field(compare=False)
    scale: Scale = field(compare=False)
    declared: bool = field(compare=False)

    @classmethod
    def of(
        cls,
        source: Point[Any],
        *,
        where: str,
        name: str,
        unit: str,
        scale: Scale,
        declared: bool = True,
        meaning: Meaning = PLAIN,
        read_after_write: bool = False,
    ) -> NamedPoint:
        """Return the point under the file's names, with its unit, scale and meaning."""
        decode, encode = source.decode, source.encode if declared else None
        if not scale.trivial:
            decode = _after(source.decode, scale.reader())
            encode = None if encode is None else _before(scale.write, encode)
        return cls(
            source.node,
            name,
            source.command,
            unit=unit or source.unit,
            decode=decode,
            encode=encode,
            meaning=meaning,
            read_after_write=read_after_write,
            where=where,
            source=source,
            scale=scale,
            declared=declared,
        )

    @property
    def key(self) -> str:
        """The node's name in the file, and the point's."""
        return f"{self.where}/{self.item}"

    @property
    def writable(self) -> bool:
        return self.declared and self.source.writable

    def bit(self, name: str) -> NamedPoint:
        """Return the point of one bit of the word, under the file's name for the node."""
        return replace(cast("NamedPoint", Point.bit(self, name)), declared=False)

    def unscaled(self, value: Any) -> Any:
        """Return the protocol's own number for a value, or its run of numbers."""
        return value if self.scale.trivial else self.scale.write(value)

    async def write(self, value: Any, **options: Unpack[CommandOptions]) -> None:
        """Write a value as `Point.write` does. A run is written in as many exchanges as it takes."""
        if self.writable and self.encode is None:
            await self.source.write(self.unscaled(value), **options)
        else:
            await Point.write(self, value, **options)


def _after(decode: Callable[[Any], Any] | None, scaled: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return scaled if decode is None else lambda raw: scaled(decode(raw))


def _before(unscaled: Callable[[Any], Any], encode: Callable[[Any], Command[None]]) -> Callable[[Any], Command[None]]:
    def scaled(value: Any) -> Command[None]:
        number = unscaled(value)
        try:
            return encode(number)
        except InvalidCommand as error:  # it names the scaled number, which the user does not know
            raise InvalidCommand(f"{value!r} cannot be sent; on the line, {error}") from None

    return scaled
