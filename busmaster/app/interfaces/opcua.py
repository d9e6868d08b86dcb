"""A line as an OPC UA server: its nodes as objects, its points as variables, with status and time."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from math import inf
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from busmaster import BusError, InvalidCommand, LineDown, Snapshot
from busmaster.app.bounds import MOST_SHOWN_POINTS
from busmaster.app.interfaces.followed_groups import FollowedGroups
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.opcua_access import Rules, guard
from busmaster.app.interfaces.opcua_connections import OpcuaServer
from busmaster.app.interfaces.opcua_space import Space, Variable
from busmaster.app.interfaces.opcua_terms import (
    AMBIGUOUS,
    CODES,
    GOOD,
    is_beyond,
    range_of,
    status_of_sample,
    status_of_write,
    type_of,
)
from busmaster.app.interfaces.reported_refusals import FailedLogins
from busmaster.app.service.picture import Row
from busmaster.app.service.record import cut
from busmaster.app.service.remote import RemoteBus
from busmaster.app.service.tcp import address_text
from busmaster.app.service.touches import Touches
from busmaster.ext import read_file

LOOK_EVERY = 0.25
"""Seconds between two looks for values that are old."""
LISTEN_AFTER = 2.0
"""Seconds after which clients are accepted although the points of the line are not known yet."""
AT_ONCE = 50
"""Values that are put before clients have their turn."""
URI = "urn:busmaster:opcua"
PRODUCT_URI = "urn:busmaster"
BUILT = datetime.fromtimestamp(0, UTC)
"""A version has no date of its build."""
NOT_WRITABLE: int = CODES.BadNotWritable
NO_SUCH_WRITE: int = CODES.BadWriteNotSupported
ACCESS_DENIED: int = CODES.BadUserAccessDenied
OUT_OF_RANGE: int = CODES.BadOutOfRange
TYPE_MISMATCH: int = CODES.BadTypeMismatch
Identity = tuple[str, int, str]
"""Protocol and address of a node, and item of a point."""

LINE = {"State": "state", "Name": "line", "Utilisation": "utilisation", "Backlog": "backlog", "Losses": "losses"}
GROUP = {name.capitalize(): name for name in ("period", "achieved", "jitter", "cycles", "missed", "paused")}
NODE = {name.capitalize(): name for name in ("health", "requests", "failed", "late")}
"""Names of variables, and the attributes of a Frame, a Group or a Node of the picture that they show."""
Place = tuple[str, str]
"""Of a variable: the object that has it, and its name."""


class Health:
    """The variables of a line, its groups and nodes, except for its points."""

    def __init__(self, space: Space, line: Following, groups: FollowedGroups) -> None:
        self._space = space
        self._line = line
        self._followed = groups
        self._objects: dict[str, ua.NodeId] = {}
        self._variables: dict[Place, Variable] = {}

    async def show(self) -> None:
        """Update the clients' view to the present state of the line, which is unknown while its program is away."""
        known = dict(self._known()) if self._line.is_connected else {}
        known["Line", "Connected"] = self._line.is_connected
        for place, value in known.items():
            if place not in self._variables:
                owner, name = place
                parent = self._space.line if owner == "Line" else self._objects[owner]
                self._variables[place] = await self._space.variable(f"{owner} {name}", name, parent)
            await self._variables[place].show(value)
        for place, variable in self._variables.items():
            if place not in known and variable.status != CODES.BadOutOfService:
                await variable.put(None, CODES.BadOutOfService, time.time())

    async def show_objects(self) -> None:
        """Have an object for each group and each node that is known."""
        for group in self._line.picture.groups:
            await self._object(f"Groups/{group.name}", group.name, self._space.groups)
        for node in self._line.picture.nodes.values():
            await self.node(node.protocol, node.address, node.label)

    async def node(self, protocol: str, address: int, label: str) -> ua.NodeId:
        """Return the object of a node."""
        return await self._object(_node(protocol, address), label, self._space.nodes)

    async def _object(self, key: str, name: str, parent: ua.NodeId) -> ua.NodeId:
        if key not in self._objects:
            self._objects[key] = await self._space.object(key, name, parent)
        return self._objects[key]

    def _known(self) -> Iterator[tuple[Place, Any]]:
        picture = self._line.picture
        if picture.frame is not None:
            yield from _shown("Line", picture.frame, LINE)
            yield ("Line", "ReadOnly"), self._line.read_only
        for group in picture.groups:
            owner = f"Groups/{group.name}"
            if owner in self._objects:
                yield from _shown(owner, group, GROUP)
                yield (owner, "Dropped"), self._followed.dropped.get(group.name, 0)
        for node in picture.nodes.values():
            owner = _node(node.protocol, node.address)
            if owner in self._objects:
                yield from _shown(owner, node, NODE)


def _node(protocol: str, address: int) -> str:
    return f"Nodes/{protocol} {address}"


def _shown(owner: str, thing: Any, names: Mapping[str, str]) -> Iterator[tuple[Place, Any]]:
    for name, field in names.items():
        yield (owner, name), getattr(thing, field)


@dataclass(slots=True)
class Shown:
    """A point that clients see. `read` is when its last value was, by the clock of the line."""

    row: Row
    variable: Variable
    writable: bool = False
    labelled: bool = False
    """Whether its values have names, by which it can be written."""
    read: float = -inf
    asked: float = -inf
    """Time of the request."""


class LineServer:
    """Shows a line that another program owns to OPC UA clients, and passes their writes on.

    `report` is called with a line for each write: the client and the result.
    """

    def __init__(self, server: Server, line: Following, rules: Rules, report: Callable[[str], None]) -> None:
        self._line = line
        self._rules = rules
        self._report = report
        self._space = Space(server)
        self._groups = FollowedGroups(line, self._take)
        self._health = Health(self._space, line, self._groups)
        self._points: dict[Identity, Shown] = {}
        self._by_id: dict[ua.NodeId, Shown] = {}
        self._keys: dict[str, Identity] = {}
        self._remote: RemoteBus | None = None
        """The connection that is shown."""
        self._touches = Touches()
        self._changed = asyncio.Event()
        self.has_points = asyncio.Event()
        """Set when clients can find the points of the line."""
        self._new_rows = True
        self._is_touched = False
        """Whether a write was reported whose values are not ambiguous yet."""

    async def run(self) -> None:
        """Show the line until cancelled."""
        await self._space.begin()
        end_picture = self._line.on_picture(self._receive)
        end_state = self._line.on_state(self._changed.set)
        end_touched = self._line.on_touched(self._receive_touched)
        try:
            while True:
                await self._show()
                with suppress(TimeoutError):
                    async with asyncio.timeout(LOOK_EVERY):
                        await self._changed.wait()
                self._changed.clear()
        finally:
            end_picture()
            end_state()
            end_touched()
            await self._groups.leave()

    def _receive(self, method: str, params: Mapping[str, Any]) -> None:
        if method == "rows":
            self._new_rows = True
        if method == "frame":
            self._changed.set()

    def _receive_touched(self, params: Mapping[str, Any]) -> None:
        self._touches.note(params)
        self._is_touched = True
        self._changed.set()

    # reading

    async def _show(self) -> None:
        """Update the clients' view to the present state of the line."""
        remote = None
        if self._line.is_connected:
            with suppress(LineDown):  # it is being left
                remote = self._line.remote
        if remote is not self._remote:  # the present state belongs to the connection before
            self._remote = remote
            self._touches = Touches()
            self._new_rows = True
            await self._groups.leave()
            await self._put_bad(CODES.BadOutOfService)
        try:
            if remote is not None:
                await self._show_points(remote)
                await self._health.show_objects()
        except (BusError, InvalidCommand) as error:  # the line's program is ending, which is reported next
            logging.getLogger("busmaster.opcua").info("%s", error)
            self._new_rows = True
        await self._health.show()

    async def _show_points(self, remote: RemoteBus) -> None:
        picture, frame = self._line.picture, self._line.picture.frame
        rows = picture.rows
        if self._new_rows and frame is not None and len(rows) == frame.points:
            self._new_rows = False
            await self._take_rows(remote, rows)
            self.has_points.set()
        if frame is not None and frame.state == "offline":
            await self._put_bad(CODES.BadNoCommunication, frame.now)
        await self._doubt_touched()
        await self._doubt_old(remote.now())

    async def _take_rows(self, remote: RemoteBus, rows: list[Row]) -> None:
        """Show these points, and no others; of a point in two groups, the values of the first."""
        wanted: dict[Identity, Row] = {}
        for row in rows:
            wanted.setdefault((row.protocol, row.address, row.item), row)
        for identity, row in wanted.items():
            await self._take_row(identity, row)
        for identity, shown in self._points.items():
            if identity not in wanted and shown.variable.status != CODES.BadConfigurationError:
                await shown.variable.put(None, CODES.BadConfigurationError, time.time())
        names = {row.group for row in wanted.values()}
        await self._groups.follow(remote, names)

    async def _take_row(self, identity: Identity, row: Row) -> None:
        details = await self._line.details(row.group, row.key)
        shown = self._points.get(identity)
        if shown is None:
            if len(self._points) >= MOST_SHOWN_POINTS:
                return
            key = self._key_of(row, identity)
            node = await self._health.node(row.protocol, row.address, row.node)
            variable = await self._space.point(key, row.item, node, f"{row.name} ({details['command']})")
            shown = self._points[identity] = self._by_id[variable.place] = Shown(row, variable)
        shown.row = row
        named = self._keys[row.key] == identity  # of two points with the same name, a write would reach the first
        shown.writable = named and row.writable and self._rules.may_be_written(row.key)
        shown.labelled = bool(details["labels"])
        await shown.variable.describe(unit=row.unit, range_=range_of(details, row.item), writable=shown.writable)

    def _key_of(self, row: Row, identity: Identity) -> str:
        """Return the identifier of a point: its key, unless another has that, as two protocols can share an address."""
        holder = self._keys.setdefault(row.key, identity)
        return row.key if holder == identity else f"{row.protocol}:{row.key}"

    # values

    async def _take(self, name: str, snapshot: Snapshot) -> None:
        taken: set[Identity] = set()
        for count, (point, sample) in enumerate(snapshot.items(), 1):
            identity = point.node.profile.name, point.node.address, point.item
            shown = self._points.get(identity)
            if shown is None or shown.row.group != name or identity in taken:
                continue
            taken.add(identity)
            shown.read = sample.finished
            shown.asked = sample.finished if sample.started is None else sample.started
            status = status_of_sample(sample)
            if status == GOOD and self._touches.is_stale(*identity, shown.asked):
                status = AMBIGUOUS  # it was read before a write that was reported first
            try:
                await shown.variable.put(sample.value, status, sample.wall)
            except (TypeError, OverflowError):
                await shown.variable.put(None, CODES.BadDataEncodingUnsupported, sample.wall)
            if count % AT_ONCE == 0:
                await asyncio.sleep(0)

    async def _put_bad(self, status: int, since: float = inf) -> None:
        """Take from the points the values that were read before this time of the line."""
        for shown in list(self._points.values()):
            if shown.read <= since and shown.variable.status not in (status, CODES.BadConfigurationError):
                await shown.variable.put(None, status, time.time())

    async def _doubt_touched(self) -> None:
        """Mark values as uncertain that were read before a write to their places."""
        if not self._is_touched:
            return
        self._is_touched = False
        for identity, shown in list(self._points.items()):
            if self._touches.is_stale(*identity, shown.asked):
                await shown.variable.doubt()

    async def _doubt_old(self, now: float) -> None:
        """Have values ambiguous that no cycle has followed: their group rests, or the line's program stands still."""
        old = self._groups.old(now)
        if old:
            for shown in list(self._points.values()):
                if shown.row.group in old:
                    await shown.variable.doubt()

    # writing

    async def write(self, wanted: ua.WriteValue, user: User) -> int:
        """Write what a client wants, through the owner's authorisation, and return the status of that.

        It is Good only for a write that the line's program has confirmed. BadTimeout is of one that may have been
        carried out; nothing has come of any other.
        """
        shown = self._by_id.get(wanted.NodeId)
        if shown is None or wanted.AttributeId != ua.AttributeIds.Value:
            return NOT_WRITABLE
        data, row = wanted.Value, shown.row
        is_stamped = data.SourceTimestamp is not None or data.ServerTimestamp is not None
        if wanted.IndexRange or is_stamped or (data.StatusCode is not None and data.StatusCode.value != GOOD):
            return NO_SUCH_WRITE  # the time of a value is that of its reply
        if not shown.writable or self._line.read_only:
            return NOT_WRITABLE
        who = f"user {user.name}" if user.name else "an anonymous user"
        if refusal := self._rules.refusal(user):
            self._report(f"{who}: {row.key} was not written: {refusal}")
            return ACCESS_DENIED
        value = _converted(data.Value, shown.variable.kind, shown.labelled)
        if value is None:
            return TYPE_MISMATCH
        text = cut(str(value))
        try:
            await self._line.write(row.group, row.key, value)
        except (BusError, InvalidCommand) as error:
            self._report(f"{who}: {row.key} = {text}: {cut(str(error))}")
            await self._doubt_touched()
            if isinstance(error, InvalidCommand) and await self._is_beyond_limits(row, value):
                return OUT_OF_RANGE
            return status_of_write(error)
        await self._doubt_touched()  # before the reply to the client, so that it never reads the old value as good
        self._report(f"{who}: {row.key} = {text}: written")
        return status_of_write(None)

    async def _is_beyond_limits(self, row: Row, value: Any) -> bool:
        """Return whether a value that was refused is outside of what the line's owner lets be written."""
        try:
            details = await self._line.details(row.group, row.key)
        except (BusError, InvalidCommand):
            return False
        return is_beyond(details, row.item, value)


def _value(variant: ua.Variant | None) -> Any:
    value = None if variant is None else variant.Value
    return tuple(value) if isinstance(value, list) else value


def _converted(variant: ua.Variant | None, kind: ua.VariantType | None, labelled: bool) -> Any:
    """Return a written value as one of the type of its variable, or None where that would change it.

    Many clients have one numeric type, or write a coil as 0 or 1. A point with labels takes their names too.
    """
    value = _value(variant)
    if isinstance(value, str):
        return value if labelled or kind in (None, ua.VariantType.String) else None
    try:
        written = type_of(value)
    except TypeError:
        return None
    if kind is None or written is kind:
        return value
    values = value if isinstance(value, tuple) else (value,)
    numbers = ua.VariantType.Int64, ua.VariantType.Double
    converted: tuple[Any, ...]
    if kind is ua.VariantType.Boolean and written in numbers and set(values) <= {0, 1}:
        converted = tuple(map(bool, values))
    elif kind is ua.VariantType.Int64 and written is ua.VariantType.Double and all(map(float.is_integer, values)):
        converted = tuple(map(int, values))
    elif kind is ua.VariantType.Double and written is ua.VariantType.Int64 and values == tuple(map(float, values)):
        converted = tuple(map(float, values))
    else:
        return None
    return converted if isinstance(value, tuple) else converted[0]


def _format_of(path: str) -> str:
    return "pem" if b"-----BEGIN" in Path(path).read_bytes() else "der"


async def load_certificate(server: Server, certificate: str, key: str) -> None:
    """Give a server its certificate and key. Raises OSError, and InvalidCommand for invalid files."""
    try:
        # by the contents of the file: the library uses the end of its name, and reads server.key as DER
        await server.load_certificate(certificate, _format_of(certificate))
        await server.load_private_key(key, format=_format_of(key))
    except (ValueError, TypeError) as error:
        raise InvalidCommand(f"{certificate} and {key} are not a certificate and its key: {error}") from None
    with suppress(x509.ExtensionNotFound):  # clients compare the name in it with the server's
        names = server.iserver.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        for uri in names.get_values_for_type(x509.UniformResourceIdentifier)[:1]:
            await server.set_application_uri(uri)


@asynccontextmanager
async def serving(
    line: Following,
    rules: Rules,
    listen: tuple[str, int],
    report: Callable[[str], None],
    *,
    certificate: tuple[str, str] | None = None,
) -> AsyncIterator[str]:
    """Serve a line by OPC UA, and follow it, within `async with`; its value is the server's address.

    `certificate` names the files of the server's certificate and its key (PEM or DER). With them, all messages are
    signed or encrypted. Raises OSError if it cannot listen there, InvalidCommand for invalid files.
    """
    server = OpcuaServer()
    await server.init()
    server.set_server_name("busmaster")
    server.product_uri, server.manufacturer_name = PRODUCT_URI, "busmaster"
    server.application_type = ua.ApplicationType.Server
    await server.set_build_info(PRODUCT_URI, "busmaster", "busmaster", version("busmaster"), "0", BUILT)
    await server.set_application_uri(URI)
    if certificate is not None:
        await load_certificate(server, *certificate)
    shown = LineServer(server, line, rules, report)
    guard(server, rules, shown.write, FailedLogins("opcua", line, report).note)
    host, port = listen
    server.set_endpoint(f"opc.tcp://{address_text(host, port)}/")
    server.socket_address = listen
    await server.start()
    try:
        async with asyncio.TaskGroup() as tasks:
            running = [tasks.create_task(shown.run()), tasks.create_task(line.follow())]
            # A client that returns after a restart of this program subscribes once. It would never get variables that
            # do not exist then.
            with suppress(TimeoutError):
                async with asyncio.timeout(LISTEN_AFTER):
                    await shown.has_points.wait()
            await server.acceptor.listen()
            yield f"opc.tcp://{address_text(host, server.acceptor.port)}/"
            for task in running:
                task.cancel()
    finally:
        await server.stop()


async def serve(
    line: Following,
    rules: Rules,
    listen: tuple[str, int],
    opened: Callable[[str], None],
    report: Callable[[str], None],
    certificate: tuple[str, str] | None,
) -> None:
    """Serve a line by OPC UA until cancelled. `opened` is called with the server's address; see `serving`."""
    async with serving(line, rules, listen, report, certificate=certificate) as url:
        opened(url)
        await asyncio.Event().wait()


def read_trusted(folder: str) -> frozenset[bytes]:
    """Return the certificates (DER) of the clients that are trusted: all of the files of a folder, PEM or DER.

    Raises OSError, and InvalidCommand for a file that is none, or a folder without one.
    """
    found = set()
    for path in sorted(Path(folder).iterdir()):
        text = read_file(path)
        try:
            pem = b"-----BEGIN" in text
            certificates = x509.load_pem_x509_certificates(text) if pem else [x509.load_der_x509_certificate(text)]
        except ValueError:
            raise InvalidCommand(f"{path} is not a certificate; {folder} is for those of trusted clients") from None
        found |= {certificate.public_bytes(Encoding.DER) for certificate in certificates}
    if not found:
        raise InvalidCommand(f"{folder} has no certificate, so no client could connect; add one")
    return frozenset(found)
