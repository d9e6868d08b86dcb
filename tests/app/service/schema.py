"""Checks messages by docs/service.schema.json."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator, ValidationError

PATH = Path(__file__).parents[3] / "docs" / "service.schema.json"
SCHEMA: dict[str, Any] = json.loads(PATH.read_text())
DEFINED: dict[str, Any] = SCHEMA["$defs"]


@functools.cache
def _validator(name: str) -> Draft202012Validator:
    """Return the validator of one definition."""
    return Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": DEFINED})


def check(name: str, message: Any) -> None:
    """Raise ValidationError for a message that is not as the schema defines it."""
    for error in _validator(name).iter_errors(message):
        raise error


def check_program(message: Any) -> None:
    """Raise ValidationError for a message that no client sends."""
    method = message.get("method")
    name = f"{method}_{'params' if 'id' in message else 'from_client'}"
    if name in DEFINED:
        check(name, message.get("params", {}))  # first: its error names the field
    check("client_message", message)


def check_owner(message: Any) -> None:
    """Raise ValidationError for a message that no owner of a line sends."""
    if "method" in message and f"{message['method']}_from_owner" in DEFINED:
        check(f"{message['method']}_from_owner", message["params"])  # first: its error names the field
    check("owner_message", message)


def check_result(method: str, result: Any) -> None:
    """Raise ValidationError for a result that the request does not have."""
    check(f"{method}_result", result)


__all__ = ["DEFINED", "SCHEMA", "ValidationError", "check", "check_owner", "check_program", "check_result"]
