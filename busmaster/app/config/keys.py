"""What a table of LINE.toml may say, as data: by these its keys are checked, and the reference is written.

Each reader declares the keys of its table beside it; those that are fields of a dataclass take kind, bounds and default
from there, so that they are said once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, TypeAlias, get_args, get_origin, get_type_hints

Kind: TypeAlias = Literal[
    "text",
    "flag",
    "whole",
    "number",
    "seconds",
    "texts",
    "table",
    "mode",
    "delay",
    "address",
    "timing",
    "port",
    "wholes",
]
"""What a key takes. "texts" are one or a list; a "delay" is seconds or two bounds, an "address" a number or a range;
"port" and "timing" are a text or a table."""

MILLION = 1_000_000
REQUIRED: Final = "required"


@dataclass(frozen=True, slots=True)
class Key:
    """Describe one key. `default` is as the file would say it, "" for none, REQUIRED where the key must be there.

    `unit` is the unit of a number, `least` and `most` its bounds. A default that depends on others is said in `about`.
    """

    name: str
    kind: Kind
    about: str
    default: str = ""
    unit: str = ""
    least: float = -math.inf
    most: float = math.inf
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TableKeys:
    """Describe one table: its header as a file has it, what it is for, and its keys in the order of the reference."""

    header: str
    about: str
    keys: tuple[Key, ...]


def names_of(keys: Iterable[Key]) -> tuple[str, ...]:
    """Return the names of keys."""
    return tuple(key.name for key in keys)


def keys_of(
    kind: type, about: Mapping[str, str], *, without: Collection[str] = (), **changes: Mapping[str, Any]
) -> tuple[Key, ...]:
    """Return the keys that are the fields of a dataclass, each with what `about` says of it.

    `changes` are what a key's own reader makes of it, by name: another kind, bounds, or a unit.
    """
    hints = get_type_hints(kind, include_extras=True)
    return tuple(
        dataclasses.replace(_key_of(part, hints[part.name], about[part.name]), **changes.get(part.name, {}))
        for part in dataclasses.fields(kind)
        if part.name not in without
    )


def _key_of(part: dataclasses.Field[Any], hint: Any, about: str) -> Key:
    least, most, choices = -math.inf, math.inf, ()
    if get_origin(hint) is Annotated:
        hint, bounds = get_args(hint)
        least, most = bounds.least, bounds.most
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        hint = str
    kinds = get_args(hint) or (hint,)
    known: tuple[tuple[type, Kind], ...] = ((bool, "flag"), (int, "whole"), (float, "number"))
    found: Kind = next(
        (name for kind, name in known if kind in kinds), "texts" if get_origin(hint) is tuple else "text"
    )
    if found == "whole":
        least = max(least, 0)
    return Key(part.name, found, about, _shown(part), "", least, most, choices)


def _shown(part: dataclasses.Field[Any]) -> str:
    if part.default is dataclasses.MISSING:
        return REQUIRED if part.default_factory is dataclasses.MISSING else ""
    match part.default:
        case None | () | "":
            return ""
        case bool():
            return str(part.default).lower()
        case float() | int():
            return f"{part.default:_}" if part.default >= MILLION else f"{part.default:g}"
    return f'"{part.default}"'
