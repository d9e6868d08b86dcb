"""msgspec, with which the messages of the service are declared, encoded and decoded.

It belongs to the extra `service`. Without the extra, `busmaster.Service` and the commands that can use a served line
must still be importable, so placeholders stand for the names that are used at import time. `check_installed` (in
connection.py) raises an error before any of them is used for a message.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msgspec import UNSET, DecodeError, Meta, Raw, Struct, UnsetType, ValidationError, convert, field, to_builtins
    from msgspec.json import Decoder, Encoder
    from msgspec.structs import asdict, replace
else:
    try:
        from msgspec import (
            UNSET,
            DecodeError,
            Meta,
            Raw,
            Struct,
            UnsetType,
            ValidationError,
            convert,
            field,
            to_builtins,
        )
        from msgspec.json import Decoder, Encoder
        from msgspec.structs import asdict, replace
    except ImportError:

        class _Placeholder:  # of a class, or of an object
            def __init__(self, *_: Any, **__: Any) -> None: ...

            def __init_subclass__(cls, **_: Any) -> None:
                super().__init_subclass__()

            encode = decode = None

        Decoder = Encoder = Meta = Raw = Struct = field = _Placeholder
        UnsetType, UNSET = type(None), None
        DecodeError = ValidationError = type("DecodeError", (ValueError,), {})
        asdict = convert = replace = to_builtins = None

__all__ = [
    "UNSET",
    "DecodeError",
    "Decoder",
    "Encoder",
    "Meta",
    "Raw",
    "Struct",
    "UnsetType",
    "ValidationError",
    "asdict",
    "convert",
    "field",
    "replace",
    "to_builtins",
]
