"""What OPC UA calls things: the status of a value or a write, the type of a value, and units of measurement."""

from __future__ import annotations

from datetime import UTC, datetime
from math import isfinite
from typing import Any

from asyncua import ua

from busmaster import GarbledReply, LineDown, LineNoisy, NodeDown, NoReply, NoSuchParameter, Quality, Refused, Sample
from busmaster.app.service.authorisation import outcome_of
from busmaster.app.service.record import Outcome

CODES = ua.StatusCodes
GOOD: int = CODES.Good
AMBIGUOUS: int = CODES.UncertainLastUsableValue
NUMBERS = (ua.VariantType.Int64, ua.VariantType.Double)
"""The types of points that are numbers."""
NO_COMMUNICATION: int = CODES.BadNoCommunication
OF_READS: tuple[tuple[type[Exception], int], ...] = (
    (NoReply, CODES.BadNoCommunication),
    (NodeDown, CODES.BadNoCommunication),
    (LineDown, CODES.BadNoCommunication),
    (GarbledReply, CODES.BadCommunicationError),
    (LineNoisy, CODES.BadCommunicationError),
    (NoSuchParameter, CODES.BadConfigurationError),
    (Refused, CODES.BadDeviceFailure),
)
"""What a value is that could not be read; the first that fits. Of others: BadNoCommunication."""
OF_WRITES: dict[Outcome, int] = {
    Outcome.WRITTEN: CODES.Good,
    Outcome.REFUSED: CODES.BadRequestNotAllowed,
    Outcome.NOT_STARTED: CODES.BadNoCommunication,
    Outcome.UNCONFIRMED: CODES.BadTimeout,
}
"""What a write is. Nothing came of those that were refused or not started; BadTimeout may have been carried out."""
UNITS = {
    "%": "P1",
    "A": "AMP",
    "Hz": "HTZ",
    "N": "NEW",
    "Nm": "NU",
    "V": "VLT",
    "W": "WTT",
    "bar": "BAR",
    "deg": "DD",
    "kW": "KWT",
    "kg": "KGM",
    "m": "MTR",
    "m/min": "2X",
    "m/s": "MTS",
    "mA": "4K",
    "min": "MIN",
    "mm": "MMT",
    "mm/s": "C16",
    "ms": "C26",
    "rad/s": "2A",
    "rpm": "RPM",
    "s": "SEC",
    "°": "DD",
    "°C": "CEL",
    "µm": "4H",
}
"""Codes of UNECE recommendation 20, from which OPC UA makes the number of a unit."""
UNECE = "http://www.opcfoundation.org/UA/units/un/cefact"


def status_of_sample(sample: Sample[Any]) -> int:
    """Return the status of what a cycle brought: a value that is older than a write to it is uncertain."""
    if sample.error is not None:
        found = (code for kind, code in OF_READS if isinstance(sample.error, kind))
        return next(found, NO_COMMUNICATION)
    return AMBIGUOUS if sample.quality is Quality.STALE else GOOD


def status_of_write(error: BaseException | None) -> int:
    """Return the status of a write that ended so; None for one that is confirmed."""
    return OF_WRITES[outcome_of(error)[0]]


def type_of(value: Any) -> ua.VariantType:
    """Return the type of a value, and of the values of a list. Raises TypeError for what OPC UA has no type for."""
    match value:
        case bool():
            return ua.VariantType.Boolean
        # A whole number beyond 64 bits with sign (a Modbus uint64) could not be encoded as Int64.
        case int() if -(2**63) <= value < 2**63:
            return ua.VariantType.Int64
        case int() | float():
            return ua.VariantType.Double
        case str():
            return ua.VariantType.String
        case tuple():
            kinds = set(map(type_of, value))
            if kinds == {ua.VariantType.Int64, ua.VariantType.Double}:
                return ua.VariantType.Double
            if len(kinds) == 1:
                return kinds.pop()
    raise TypeError(f"OPC UA has no type for {value!r}")


def widened(before: ua.VariantType | None, value: Any) -> ua.VariantType:
    """Return the type of a variable that has had values of the type `before`, and has this one now.

    A quantity that was whole by chance is a Double from its first fraction on, and stays one.
    """
    kind = type_of(value)
    return before if (before, kind) == (ua.VariantType.Double, ua.VariantType.Int64) and before else kind


def variant_of(value: Any, kind: ua.VariantType) -> ua.Variant:
    """Return a value as one of this type."""
    if kind is not ua.VariantType.Double:
        return ua.Variant(list(value) if isinstance(value, tuple) else value, kind)
    return ua.Variant(list(map(float, value)) if isinstance(value, tuple) else float(value), kind)


def unit_of(text: str) -> ua.EUInformation:
    """Return a unit: with its number where UNECE has one, -1 where not."""
    unit = ua.EUInformation()
    unit.NamespaceUri = UNECE
    unit.UnitId = -1
    for character in UNITS.get(text, ""):
        unit.UnitId = max(unit.UnitId, 0) * 256 + ord(character)
    unit.DisplayName = unit.Description = ua.LocalizedText(text)
    return unit


def range_of(details: Any, item: str) -> ua.Range | None:
    """Return the range of a point: the limits for writes, else the limits of its alarm.

    `details` is the owner's description of the point. None if one end of the range is unknown.
    """
    bounds = [(limit["minimum"], limit["maximum"]) for limit in details["limits"] if limit["name"] == item]
    for low, high in (*bounds, (details["low"], details["high"])):
        if low is not None and high is not None and isfinite(low) and isfinite(high):
            found = ua.Range()
            found.Low, found.High = float(low), float(high)
            return found
    return None


def is_beyond(details: Any, item: str, value: Any) -> bool:
    """Return whether a value is outside of what may be written to a point. `details` is as in `range_of`."""
    values = value if isinstance(value, tuple) else (value,)
    bounds = [(limit["minimum"], limit["maximum"]) for limit in details["limits"] if limit["name"] == item]
    return any(
        (low is not None and number < low) or (high is not None and number > high)
        for low, high in bounds
        for number in values
        if isinstance(number, int | float)
    )


def time_of(moment: float) -> datetime:
    """Return a time in seconds since 1970 as OPC UA has it."""
    return datetime.fromtimestamp(moment, UTC)
