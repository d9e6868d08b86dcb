"""Errors on their way from the line's owner to a client: the same classes there, with the same fields."""

from __future__ import annotations

from collections.abc import Iterator

from busmaster import BusError, InvalidCommand, Refused
from busmaster.app.service.fields import BusErrorData, InvalidCommandData
from busmaster.app.service.messages import BUS_ERROR, INTERNAL, INVALID_PARAMS, InvalidParams, Malformed, encode
from busmaster.app.service.owner_messages import ErrorForm
from busmaster.app.service.typed import UNSET, Decoder, Raw, Struct, UnsetType

FIELDS = ("what", "line", "label", "address", "command", "attempts", "hint")
DEEPEST = 5
"""Maximum number of causes of an error that are sent."""
START_OWNER = "start it, and connect again"
"""Advice for a program whose line has lost its owner."""
REFUSED = (
    BusError,
    Malformed,
    TypeError,
    ValueError,
    OverflowError,  # a number of some hundred digits
    RecursionError,  # a list in a list in a list
)
"""Exceptions of a request: from the line, or from values whose type is the protocol's affair."""


def _classes(kind: type[BusError]) -> Iterator[type[BusError]]:
    """Yield a class and its subclasses."""
    yield kind
    for subclass in kind.__subclasses__():
        yield from _classes(subclass)


KNOWN = {kind.__name__: kind for kind in _classes(BusError) if kind.__module__ == BusError.__module__}
"""The errors of the library, by name. Those of a program are unknown to its clients."""


def encode_error(error: Exception) -> ErrorForm:
    """Return an error in the form of JSON-RPC; its class is in its `data`."""
    if isinstance(error, Malformed):
        return ErrorForm(error.code, str(error))
    if isinstance(error, BusError):
        return ErrorForm(BUS_ERROR, str(error), Raw(encode(error_data(error))))
    if isinstance(error, InvalidCommand):
        return ErrorForm(INVALID_PARAMS, str(error), Raw(encode(InvalidCommandData("InvalidCommand", str(error)))))
    return ErrorForm(INTERNAL, f"{type(error).__name__}: {error}")


def refusal_of(method: str, error: Exception) -> Exception:
    """Return why a request is refused, as text for its program. Exceptions from invalid values get a text with the
    method.
    """
    if isinstance(error, BusError | InvalidCommand | Malformed):
        return error
    return InvalidParams(method, f"{type(error).__name__}: {error}")


def error_data(error: BusError, depth: int = 0) -> BusErrorData:
    """Return the class of an error by the nearest name that every client knows, and its fields."""
    name = next((kind.__name__ for kind in type(error).__mro__ if kind.__name__ in KNOWN), "BusError")
    confirm: bool | UnsetType = UNSET
    temporary: bool | UnsetType = UNSET
    if isinstance(error, Refused):
        confirm, temporary = error.confirm, True if error.temporary else UNSET
    cause: str | BusErrorData | UnsetType = UNSET
    if error.__cause__ is not None and depth < DEEPEST:
        text = f"{type(error.__cause__).__name__}: {error.__cause__}"
        cause = error_data(error.__cause__, depth + 1) if isinstance(error.__cause__, BusError) else text
    return BusErrorData(
        name,
        error.what,
        error.line,
        error.label,
        error.address,
        error.command,
        error.attempts,
        error.hint,
        confirm,
        temporary,
        cause,
    )


def error_of(form: ErrorForm) -> Exception:
    """Return a new error with all fields of the received one."""
    if isinstance(form.data, UnsetType):
        return BusError(f"the program that owns the line could not do it: {form.message}", hint="see its log")
    if _ERROR_NAME.decode(form.data).error == "InvalidCommand":
        return InvalidCommand(_INVALID_COMMAND.decode(form.data).what)
    return bus_error_of(_BUS_ERROR.decode(form.data))


def bus_error_of(data: BusErrorData) -> BusError:
    """Return the BusError that has these fields."""
    error = KNOWN.get(data.error, BusError)(data.what)
    for field in FIELDS:
        if getattr(error, field) != getattr(data, field):  # a hint that its class has is not kept twice
            setattr(error, field, getattr(data, field))
    if isinstance(error, Refused):
        error.confirm, error.temporary = data.confirm is not False, data.temporary is True
    if not isinstance(data.cause, UnsetType):
        error.__cause__ = bus_error_of(data.cause) if isinstance(data.cause, BusErrorData) else Exception(data.cause)
    return error


class _ErrorName(Struct, frozen=True):
    error: str


_ERROR_NAME = Decoder(_ErrorName)
_INVALID_COMMAND = Decoder(InvalidCommandData)
_BUS_ERROR = Decoder(BusErrorData)
