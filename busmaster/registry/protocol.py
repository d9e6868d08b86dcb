"""The description of one protocol for the rest of the package: a frozen object, created in the protocol's own
folder."""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from busmaster.contract.items import Item
from busmaster.errors import InvalidCommand

if TYPE_CHECKING:  # so that a master does not import the emulator
    from busmaster.bus.handle import Handle
    from busmaster.contract.exchange import Command
    from busmaster.contract.frames import Dialect
    from busmaster.contract.profile import Profile
    from busmaster.emulator.device import Device

NAME = re.compile(r"[a-z][a-z0-9_-]*")
HIGHEST_CAPTURE_ID = 255

OptionKind: TypeAlias = Literal[
    "flag", "whole", "number", "positive", "share", "delay", "text", "numbers", "addresses", "tables"
]
"""Type of an option in LINE.toml, and of the argument.

A "whole" number is 1 or more; "positive" is any number above 0, "share" one from 0 to 1. A "delay" is a number of
seconds or two bounds; the argument is a `Delay`. "numbers" is a list of whole numbers; the argument is a frozenset.
"addresses" is a table of names and their addresses. "tables" are tables by name, of `fields`.
"""


@dataclass(frozen=True, slots=True)
class Option:
    """An option of one kind of node: an argument with that name.

    It is an argument of their handle, of reading an item, or of creating their emulated device. `help`: text for the
    command line; without it the option exists only in LINE.toml. `about`: text for the reference of LINE.toml, a whole
    sentence with unit and default, if `help` is not sufficient. `common`: it can also be set for all nodes of the kind,
    in [protocols.NAME].
    """

    name: str
    kind: OptionKind
    help: str = ""
    common: bool = True
    choices: tuple[str, ...] = ()
    """The allowed texts; () for any text."""
    fields: tuple[Option, ...] = ()
    """The fields of each of its tables."""
    about: str = ""
    reader: Callable[[str], Mapping[str, int]] | None = None
    """For "addresses": reads them from the text of a file, which LINE.toml may name instead of the table. Raises
    InvalidCommand with the lines that it cannot read; it never guesses."""


class DeviceMaker(typing.Protocol):
    """Creates an emulated device.

    It is called with an address, `delay`, `traceable`, `lively`, and the given options of `NodeKind.emulated`. `delay`:
    a Delay. `traceable`: None, or a TraceableMemory with all values of the device; its modulus must be one that the
    protocol can carry. `lively`: something moves from the start. Raises InvalidCommand for an address or an option that
    the device cannot have.
    """

    def __call__(self, address: int, /, *args: Any, **options: Any) -> Device: ...


def device_of(module: str) -> DeviceMaker:
    """Return the `make_device` of a module, which is imported when the first device is created."""

    def make_device(address: int, /, **options: Any) -> Device:
        device: Device = import_module(module).make_device(address, **options)
        return device

    return make_device


def everywhere(item: str) -> bool:
    """Return True for every item."""
    return True


def usual_width(item: str) -> int:
    """Return 32 for every item."""
    return 32


def nowhere(item: str) -> bool:
    """Return False for every item."""
    return False


@dataclass(frozen=True, slots=True, eq=False)
class NodeKind:
    """The nodes with one name on the command line, in LINE.toml and in captures.

    Most protocols have one kind, with the protocol's own name.
    """

    name: str
    handle: type[Handle]
    make_device: DeviceMaker
    items: str
    """The form of an ITEM of such a node, for the command line's help, which wraps it between words."""
    probe_item: str = ""
    """The ITEM that the profile's probe reads."""
    documented: tuple[Item, ...] = ()
    """Descriptions of single items from the protocol's document."""
    options: tuple[Option, ...] = ()
    """Arguments of its handle."""
    read_options: tuple[Option, ...] = ()
    """Arguments of its handle's `_read_item`, for the command line."""
    emulated: tuple[Option, ...] = ()
    """Arguments of `make_device`, set in [emulator.nodes.NAME]. An argument that is in `options` too has the node's
    value by default."""
    whole_numbers: Callable[[str], bool] = nowhere
    """Returns True if the line carries whole numbers for an item. A value scaled by LINE.toml is then rounded."""
    width: Callable[[str], int] = usual_width
    """Returns the number of bits of an item's whole number, so that LINE.toml can name them; 0 for a run of several."""
    takes_decimals: bool = False
    """Its handle has an argument `decimals` (digits by item), and scales or rounds with it: LINE.toml does not."""
    capture_id: int = 0
    """Its id in the header of captured frames, for the dissector, in addition to its name. 0: name only."""
    protocol: Protocol = field(init=False, repr=False)
    """Set by the protocol that lists it."""

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise InvalidCommand(f"{self.name!r} is not a valid name of a protocol: use small letters, digits, - and _")
        if not 0 <= self.capture_id <= HIGHEST_CAPTURE_ID:
            raise InvalidCommand(f"{self.name}: a capture id is 0 to {HIGHEST_CAPTURE_ID}, not {self.capture_id}")

    @property
    def profile(self) -> Profile:
        """Return the profile of this kind of node: the protocol's, with the probe and the sync reads of its handle."""
        return self.handle.profile

    def decimals(self, item: str) -> int:
        """Return how many of an item's last digits on the line are decimals according to the document, else 0."""
        name = item.partition(":")[0]
        return next((one.decimals for one in self.documented if one.item == name), 0)


@dataclass(frozen=True, slots=True, eq=False)
class Protocol:
    """All that the rest of the package knows about one protocol.

    `kinds`: the kinds of nodes that use it. Frames belong to the first one if no kind is given. `commands`: all its
    commands, by their names in stored form. `dialect`: creates a reader for captures.
    """

    profile: Profile
    kinds: tuple[NodeKind, ...]
    commands: Mapping[str, type[Command[Any]]]
    dialect: Callable[[], Dialect]

    def __post_init__(self) -> None:
        if not self.kinds:
            raise InvalidCommand(f"{self.profile.name}: a protocol has at least one kind of node")
        for kind in self.kinds:
            object.__setattr__(kind, "protocol", self)  # frozen, but created before the protocol that contains it

    @property
    def name(self) -> str:
        """Return the name of the protocol, as `--protocol` takes it for its first kind of node."""
        return self.profile.name

    def write_down(self, command: Command[Any]) -> dict[str, Any]:
        """Return a command as plain values for JSON: its name, and the arguments that differ from the defaults.

        Raises InvalidCommand for a command that is not of this protocol.
        """
        for name, kind in self.commands.items():
            if type(command) is kind:
                return {"command": name, **_arguments_of(command)}
        raise InvalidCommand(f"{self.name} has no command {type(command).__name__}")

    def read_back(self, written: Mapping[str, Any]) -> Command[Any]:
        """Create the command from its stored form, which checks it again. Raises InvalidCommand."""
        name = written.get("command")
        kind = self.commands.get(str(name))
        if kind is None:
            raise InvalidCommand(f"{self.name} has no command {name!r}: use {', '.join(self.commands)}")
        arguments = {key: _frozen(value) for key, value in written.items() if key != "command"}
        form = _form_of(kind)
        if not form.needed <= arguments.keys() <= form.defaults.keys():
            wrong = ", ".join(sorted(form.needed - arguments.keys() | arguments.keys() - form.defaults.keys()))
            raise InvalidCommand(f"{self.name}: {name} has the arguments {', '.join(form.defaults)}: look at {wrong}")
        for part in form.options:
            # A Boolean must be true or false: numbers and texts are rejected.
            if not isinstance(arguments.get(part, False), bool):
                raise InvalidCommand(f"{self.name}: {name}: {part} is true or false, not {arguments[part]!r}")
        try:
            return kind(**arguments)
        except InvalidCommand:
            raise
        except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
            raise InvalidCommand(f"{self.name}: {name}: {error}") from None


def _arguments_of(command: Command[Any]) -> dict[str, Any]:
    defaults = _form_of(type(command)).defaults
    return {name: value for name, default in defaults.items() if (value := getattr(command, name)) != default}


class _Form(typing.NamedTuple):
    """The arguments of a command: names and defaults, those without a default, and those that are true or false."""

    defaults: Mapping[str, Any]
    needed: frozenset[str]
    options: tuple[str, ...]


@cache  # used at both ends of each remote request
def _form_of(kind: type[Command[Any]]) -> _Form:
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]  # every command is a dataclass
    defaults = {part.name: part.default for part in fields if part.init}
    needed = frozenset(name for name, default in defaults.items() if default is dataclasses.MISSING)
    return _Form(defaults, needed, tuple(name for name, default in defaults.items() if isinstance(default, bool)))


def _frozen(value: Any) -> Any:
    """Return a list, which is JSON's form of a tuple, as a tuple."""
    return tuple(map(_frozen, value)) if isinstance(value, (list, tuple)) else value
