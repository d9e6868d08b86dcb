"""docs/service.schema.json, and what is held against it."""

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
    """What checks one definition."""
    return Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": DEFINED})


def check(name: str, said: Any) -> None:
    """Raise ValidationError for what is not as the schema defines it."""
    for error in _validator(name).iter_errors(said):
        raise error


def check_program(said: Any) -> None:
    """Raise ValidationError for what no program says."""
    method = said.get("method")
    part = "params" if "id" in said else "told"
    check(f"{method}_{part}" if f"{method}_{part}" in DEFINED else "from_program", said.get("params", {}))
    check("from_program", said)


def check_owner(said: Any) -> None:
    """Raise ValidationError for what no owner of a line says."""
    if "method" in said and f"{said['method']}_news" in DEFINED:
        check(f"{said['method']}_news", said["params"])  # first: its message says what is wrong
    check("from_owner", said)


def check_result(method: str, result: Any) -> None:
    """Raise ValidationError for what is no answer to a request."""
    check(f"{method}_result", result)


def heard(text: str) -> Any:
    """What a message is on the other side."""
    return json.loads(text)


__all__ = ["DEFINED", "SCHEMA", "ValidationError", "check", "check_owner", "check_program", "check_result", "heard"]
