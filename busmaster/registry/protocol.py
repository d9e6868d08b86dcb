"""What one protocol is to the rest of the package: a frozen object, made in the protocol's own folder."""

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

if TYPE_CHECKING:  # so that a master alone does not load the emulator
    from busmaster.bus.handle import Handle
    from busmaster.capture.decode import Dialect
    from busmaster.contract.exchange import Command
    from busmaster.contract.profile import Profile
    from busmaster.emulator.device import Device

NAME = re.compile(r"[a-z][a-z0-9_-]*")
HIGHEST_CAPTURE_ID = 255

OptionKind: TypeAlias = Literal[
    "flag", "whole", "number", "positive", "share", "delay", "text", "numbers", "addresses", "tables"
]
"""What an option can be in LINE.toml, and as what the argument comes.

A "whole" number is 1 or more; "positive" is any number above 0, "share" one from 0 to 1. A "delay" is a number of
seconds or two bounds, and comes as a `Delay`. "numbers" is a list of whole numbers, and comes as a frozenset;
"addresses" a table of names and the address that each stands for; "tables" are tables by name, of `fields`.
"""


@dataclass(frozen=True, slots=True)
class Option:
    """Describe one thing that can be said of nodes of one kind alone: an argument of that name.

    It is an argument of their handle, of reading an item, or of making their emulated device. `help` is what the
    command line says of it; without one it can be said in LINE.toml alone. `about` is what the reference of LINE.toml
    says of it, a whole sentence with its unit and default, where `help` is not all. `common`: it may also be said once
    for all nodes of the kind, in [protocols.NAME].
    """

    name: str
    kind: OptionKind
    help: str = ""
    common: bool = True
    choices: tuple[str, ...] = ()
    """All texts that it can be; () if it can be any."""
    fields: tuple[Option, ...] = ()
    """What each of its tables may say."""
    about: str = ""
    reader: Callable[[str], Mapping[str, int]] | None = None
    """Of "addresses": reads them from the text of a file, which LINE.toml may name in place of the table. Raises
    InvalidCommand, naming the lines that it cannot read: none is guessed."""


class DeviceMaker(typing.Protocol):
    """Makes an emulated device.

    It is called with an address, `delay`, `traceable`, `lively`, and those of `NodeKind.emulated` that were said.
    `delay` is a Delay. `traceable` is None or a TraceableMemory whose every value the device holds; its modulus must be
    one that the protocol can carry. `lively` is True if something is to move on it from the start. Raises
    InvalidCommand for an address or an option that the device cannot have.
    """

    def __call__(self, address: int, /, *args: Any, **options: Any) -> Device: ...


def device_of(module: str) -> DeviceMaker:
    """Return the `make_device` of a module that is not imported before the first device is made."""

    def make_device(address: int, /, **options: Any) -> Device:
        device: Device = import_module(module).make_device(address, **options)
        return device

    return make_device


def everywhere(item: str) -> bool:
    """Return True, whatever the item."""
    return True


def usual_width(item: str) -> int:
    """Return 32, whatever the item."""
    return 32


def nowhere(item: str) -> bool:
    """Return False, whatever the item."""
    return False


@dataclass(frozen=True, slots=True, eq=False)
class NodeKind:
    """Describe the nodes that go by one name: on the command line, in LINE.toml and in captures.

    Most protocols have one kind, of the protocol's own name.
    """

    name: str
    handle: type[Handle]
    make_device: DeviceMaker
    items: str
    """What an ITEM of such a node looks like, for the command line's help; its words are wrapped there."""
    probe_item: str = ""
    """The ITEM that the profile's probe reads."""
    documented: tuple[Item, ...] = ()
    """What the protocol's document says of items, one by one."""
    options: tuple[Option, ...] = ()
    """Arguments of its handle."""
    read_options: tuple[Option, ...] = ()
    """Arguments of its handle's `_read_item`, for the command line."""
    emulated: tuple[Option, ...] = ()
    """Arguments of `make_device`, said in [emulator.nodes.NAME]. One that is among `options` too is as the node says,
    unless it is said there."""
    whole_numbers: Callable[[str], bool] = nowhere
    """Whether the line carries whole numbers for an item: a value scaled by LINE.toml is then rounded to one."""
    width: Callable[[str], int] = usual_width
    """How many bits the whole number of an item has, so that LINE.toml can give them names; 0 for a run of several."""
    takes_decimals: bool = False
    """Its handle has an argument `decimals`, digits by item, and scales or rounds by it: LINE.toml does not."""
    capture_id: int = 0
    """What the header of a captured frame calls it beside its name, for the dissector. 0: by its name alone."""
    protocol: Protocol = field(init=False, repr=False)
    """Set by the protocol that lists it."""

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise InvalidCommand(f"{self.name!r} is no name of a protocol: use small letters, digits, - and _")
        if not 0 <= self.capture_id <= HIGHEST_CAPTURE_ID:
            raise InvalidCommand(f"{self.name}: a capture id is 0 to {HIGHEST_CAPTURE_ID}, not {self.capture_id}")

    @property
    def profile(self) -> Profile:
        """Return the profile of this kind of node: the protocol's, with the probe and the sync reads of its handle."""
        return self.handle.profile

    def decimals(self, item: str) -> int:
        """Return how many of an item's last digits on the line are decimals, as the document has it; else 0."""
        name = item.partition(":")[0]
        return next((one.decimals for one in self.documented if one.item == name), 0)


@dataclass(frozen=True, slots=True, eq=False)
class Protocol:
    """Hold all that the rest of the package knows of one protocol.

    `kinds` are the kinds of nodes that speak it; the first is what its frames are taken to be from where nobody says.
    `commands` are all its commands, by the names under which they are written down. `dialect` makes a reader of
    captures.
    """

    profile: Profile
    kinds: tuple[NodeKind, ...]
    commands: Mapping[str, type[Command[Any]]]
    dialect: Callable[[], Dialect]

    def __post_init__(self) -> None:
        if not self.kinds:
            raise InvalidCommand(f"{self.profile.name}: a protocol has at least one kind of node")
        for kind in self.kinds:
            object.__setattr__(kind, "protocol", self)  # frozen, but made before the protocol that lists it

    @property
    def name(self) -> str:
        """Return the name of the protocol, as `--protocol` takes it for its first kind of node."""
        return self.profile.name

    def write_down(self, command: Command[Any]) -> dict[str, Any]:
        """Return a command as plain values, which JSON can carry: its name, and what it does not say by default.

        Raises InvalidCommand for a command that is not of this protocol.
        """
        for name, kind in self.commands.items():
            if type(command) is kind:
                return {"command": name, **_arguments_of(command)}
        raise InvalidCommand(f"{self.name} has no command {type(command).__name__}")

    def read_back(self, written: Mapping[str, Any]) -> Command[Any]:
        """Build the command that was written down, and so check it again. Raises InvalidCommand."""
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
            # An option has one form: neither a number nor a text stands for true.
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
    """What a command is made of: names and defaults, those that have none, and those that are true or false."""

    defaults: Mapping[str, Any]
    needed: frozenset[str]
    options: tuple[str, ...]


@cache  # each remote request asks at either end
def _form_of(kind: type[Command[Any]]) -> _Form:
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]  # every command is a dataclass
    defaults = {part.name: part.default for part in fields if part.init}
    needed = frozenset(name for name, default in defaults.items() if default is dataclasses.MISSING)
    return _Form(defaults, needed, tuple(name for name, default in defaults.items() if isinstance(default, bool)))


def _frozen(value: Any) -> Any:
    """Return a list, which is what JSON makes of a tuple, as a tuple again."""
    return tuple(map(_frozen, value)) if isinstance(value, (list, tuple)) else value
