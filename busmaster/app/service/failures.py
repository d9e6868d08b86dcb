"""Errors on their way from the line's owner to a client: the same classes there, with the same fields."""

from __future__ import annotations

from typing import Any

from busmaster import errors
from busmaster.app.service.messages import BUS_ERROR, INTERNAL, INVALID_PARAMS, Malformed
from busmaster.errors import BusError, InvalidCommand, Refused

FIELDS = ("what", "line", "label", "address", "command", "attempts", "hint")
DEEPEST = 5
"""Maximum number of causes of an error that are sent."""
REFUSED = (
    BusError,
    Malformed,
    KeyError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,  # a number of some hundred digits
    RecursionError,  # a list in a list in a list
)
"""Exceptions of a request: from the line, or from invalid parameters."""
KNOWN: dict[str, type[BusError]] = {
    name: thing
    for name in errors.__all__
    if isinstance(thing := getattr(errors, name), type) and issubclass(thing, BusError)
}


def encode_error(error: Exception) -> dict[str, Any]:
    """Return an error in the form of JSON-RPC; its class is in its `data`."""
    if isinstance(error, Malformed):
        return {"code": error.code, "message": str(error)}
    if isinstance(error, BusError):
        return {"code": BUS_ERROR, "message": str(error), "data": error_data(error)}
    if isinstance(error, InvalidCommand):
        return {"code": INVALID_PARAMS, "message": str(error), "data": {"error": "InvalidCommand", "what": str(error)}}
    return {"code": INTERNAL, "message": f"{type(error).__name__}: {error}"}


def refusal_of(method: str, error: Exception) -> Exception:
    """Return why a request is refused, as text for its program. Exceptions from invalid parameters get a text with the
    method.
    """
    if isinstance(error, BusError | InvalidCommand | Malformed):
        return error
    what = f"{error} is missing" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
    return InvalidCommand(f"{method}: {what}; service.schema.json has its parameters")


def error_data(error: BusError, depth: int = 0) -> dict[str, Any]:
    """Return the class of an error by the nearest name that every client knows, and its fields."""
    name = next((kind.__name__ for kind in type(error).__mro__ if kind.__name__ in KNOWN), "BusError")
    data: dict[str, Any] = {"error": name, **{field: getattr(error, field) for field in FIELDS}}
    if isinstance(error, Refused):
        data |= {"confirm": error.confirm} | ({"temporary": True} if error.temporary else {})
    cause = error.__cause__
    if cause is not None and depth < DEEPEST:
        text = f"{type(cause).__name__}: {cause}"
        data["cause"] = error_data(cause, depth + 1) if isinstance(cause, BusError) else text
    return data


def error_of(decoded: dict[str, Any]) -> Exception:
    """Return a new error with all fields of the received one."""
    data = decoded.get("data") or {}
    if data.get("error") == "InvalidCommand":
        return InvalidCommand(data["what"])
    if data:
        return bus_error_of(data)
    return BusError(f"the program that owns the line could not do it: {decoded.get('message')}", hint="see its log")


def bus_error_of(data: dict[str, Any]) -> BusError:
    """Return the BusError that has these fields."""
    kind = KNOWN.get(data["error"], BusError)
    error = kind(data["what"])
    for field in FIELDS:
        if getattr(error, field) != data.get(field):  # a hint that its class has is not kept twice
            setattr(error, field, data.get(field))
    if isinstance(error, Refused):
        error.confirm, error.temporary = data.get("confirm", True), data.get("temporary", False)
    cause = data.get("cause")
    if cause is not None:
        error.__cause__ = bus_error_of(cause) if isinstance(cause, dict) else Exception(cause)
    return error
