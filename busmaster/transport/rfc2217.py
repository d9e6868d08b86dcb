"""A serial port of a serial server that sets its rate and framing by RFC 2217.

The bytes are those of a `TcpPort`, with a telnet codec in between: see `telnet.py`. The connection behaves as that of
a TcpPort does (keepalive, unacknowledged data, reconnecting), because it is one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Any, NamedTuple, cast

from busmaster.arbiter.counters import DriverErrors, Mark
from busmaster.contract.arguments import Between
from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand, LineDown
from busmaster.transport import telnet
from busmaster.transport.identity import Identity
from busmaster.transport.marks import taker_of_marked_bytes
from busmaster.transport.tcp import TcpPort
from busmaster.transport.telnet import BINARY, COM_PORT, DO, DONT, SUPPRESS_GO_AHEAD, WILL, WONT, Control, LineError

CONFIRM_DEADLINE = 5.0
"""Seconds for which the server may take to agree to the options, and again to confirm the settings."""
FASTEST = 0xFFFF_FFFF
"""The largest baud rate that fits into SET-BAUDRATE."""
REQUIRED = frozenset({(DO, COM_PORT), (DO, BINARY), (WILL, BINARY)})
"""The options that the server must agree to. Without binary transmission it may change CR bytes, and drop the eighth
bit."""
AGREED = REQUIRED | {(DO, SUPPRESS_GO_AHEAD), (WILL, SUPPRESS_GO_AHEAD)}
"""The server's replies to the options that this side requests at the beginning. They are not replied to."""


AGREEMENT = "options"
"""Key of the wait until the server has agreed to all REQUIRED options."""


@dataclass(frozen=True, slots=True)
class Rfc2217Port(TcpPort):
    """A serial line behind a serial server that takes its settings by RFC 2217.

    The server must confirm rate and framing when the port is opened, otherwise the opening fails. `receive_latency`,
    `echo` and `paced` are as for a TcpPort. Raises InvalidCommand for values out of range.
    """

    _: KW_ONLY
    baudrate: Annotated[int, Between(1, self_checked=True)]
    """In LINE.toml the protocol's by default, where all nodes are meant for one."""
    bytesize: Annotated[int, Between(5, 8, self_checked=True)] = 8
    """Bits of a byte. In LINE.toml the protocol's by default."""
    parity: str = "N"
    """N, E, O, M or S. In LINE.toml the protocol's by default."""
    stopbits: float = 1
    """1, 1.5 or 2. In LINE.toml the protocol's by default."""
    rtscts: bool = False
    """Whether the server sends only while CTS of the remote port is on."""
    dtr: bool | None = None
    """Sets (true) or clears (false) the line DTR of the remote port. By default the server decides."""
    rts: bool | None = None
    """The same for RTS."""

    def __post_init__(self) -> None:
        TcpPort.__post_init__(self)  # super() does not work in a dataclass with slots
        LineSettings(self.baudrate, self.bytesize, self.parity, self.stopbits)
        if self.baudrate > FASTEST:
            raise InvalidCommand(f"RFC 2217 has baud rates up to {FASTEST}, not {self.baudrate}")
        if self.rtscts and self.rts is not None:
            raise InvalidCommand("rtscts and rts exclude each other: both drive the RTS line")

    @property
    def settings(self) -> LineSettings:
        """Return baud rate and framing."""
        return LineSettings(self.baudrate, self.bytesize, self.parity, self.stopbits)

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> Rfc2217Transport:
        """Connect, and set the remote port. Raises LineDown, also where the server does not confirm the settings."""
        # A stream of its own until the settings are confirmed: a line must not be used at another baud rate.
        stream = _Stream(self.name)
        tcp = await TcpPort.open(self, lambda: stream, only)
        try:
            # Each step may take CONFIRM_DEADLINE: a server that does not speak telnet at all fails here, with a hint.
            await stream.agree()
            await stream.configure(self.settings)
            # After rate and framing: DTR or RTS may switch the device on.
            await stream.control(self._controls())
            transport = Rfc2217Transport(tcp, stream)
            stream.attach(protocol_factory(), transport)
        except BaseException:
            tcp.abort()
            raise
        return transport

    def _controls(self) -> list[tuple[Control, bool]]:
        """Return the SET-CONTROL commands, each with whether the server must confirm it."""
        found = [(Control.RTS_CTS, True) if self.rtscts else (Control.NO_FLOW_CONTROL, False)]
        if self.dtr is not None:
            found.append((Control.DTR_ON if self.dtr else Control.DTR_OFF, True))
        if self.rts is not None:
            found.append((Control.RTS_ON if self.rts else Control.RTS_OFF, True))
        return found


class ModemLines(NamedTuple):
    """The inputs of the remote port, as the server reported them last."""

    cts: bool
    dsr: bool
    ri: bool
    cd: bool


class Rfc2217Transport(asyncio.Transport):
    """Doubles IAC in sent bytes, and holds them back while the server requests that."""

    def __init__(self, tcp: asyncio.Transport, stream: _Stream) -> None:
        super().__init__()
        self._tcp = tcp
        self._stream = stream
        # The server may have suspended the connection during the opening.
        self._held: bytes | None = b"" if stream.suspended else None

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return the last ModemLines or None for `modem_lines`, and a function for `line_errors`.

        The function returns the error counters, or None if the server does not report errors. Other names are those of
        the TCP transport.
        """
        if name == "modem_lines":
            return self._stream.modem_lines
        if name == "line_errors":
            return self._stream.line_errors
        return self._tcp.get_extra_info(name, default)

    async def tune(self, settings: LineSettings) -> None:
        """Set the remote port to another rate and framing. Raises LineDown where the server does not confirm them."""
        await self._stream.configure(settings)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if self._held is None:
            self._tcp.write(telnet.escaped(bytes(data)))
        else:
            self._held += telnet.escaped(bytes(data))
            # R2: held bytes have not left, so no window may expire.
            self._stream.pause_writing()

    def suspend(self, on: bool) -> None:
        """Hold back all bytes written from now on, or send the bytes that were held back."""
        if on:
            self._held = self._held or b""
            return
        held, self._held = self._held, None
        if held:
            self._tcp.write(held)
            # Otherwise the TCP transport reports it when its buffer is empty.
            if not self._tcp.get_write_buffer_size():
                self._stream.resume_writing()

    def get_write_buffer_size(self) -> int:
        return self._tcp.get_write_buffer_size() + len(self._held or b"")

    def is_closing(self) -> bool:
        return self._tcp.is_closing()

    def pause_reading(self) -> None:
        self._tcp.pause_reading()

    def resume_reading(self) -> None:
        self._tcp.resume_reading()

    def close(self) -> None:
        self._tcp.close()

    def abort(self) -> None:
        self._tcp.abort()


class _Stream(asyncio.Protocol):
    """The protocol of the TCP connection: answers the server's commands, and passes the data to the protocol above.

    What arrives before that is attached, such as a banner, is discarded.
    """

    def __init__(self, name: str) -> None:
        self.modem_lines: ModemLines | None = None
        self.suspended = False
        """The server has requested a pause."""
        self._name = name
        self._tcp: asyncio.Transport | None = None
        self._reader = telnet.TelnetReader()
        self._missing = set(REQUIRED)
        self._answered: set[tuple[int, int]] = set()
        self._waiting: dict[object, asyncio.Future[bytes]] = {}
        self._protocol: asyncio.Protocol | None = None
        self._transport: Rfc2217Transport | None = None
        self._cause: LineDown | None = None
        self._errors_reported = False
        self._errors = dict.fromkeys(LineError, 0)

    # opening

    async def agree(self) -> None:
        """Agree on the options with the server. Raises LineDown."""
        if self._missing:
            hint = "check that the port speaks telnet with RFC 2217; for raw TCP use socket://"
            await self._answer(AGREEMENT, "agree to RFC 2217", hint)

    async def configure(self, settings: LineSettings) -> None:
        """Set rate and framing, and have line errors reported. Raises LineDown unless the server confirms the former.

        The mask of line errors is sent without waiting: many servers take it and never confirm it.
        """
        wanted = telnet.values_of(settings)
        self._expect(*wanted)
        self._send(
            b"".join(telnet.subnegotiation(command, value) for command, value in wanted.items())
            # A server reports only the errors in the mask.
            + telnet.subnegotiation(telnet.Set.LINESTATE_MASK, bytes((telnet.LINE_ERRORS,)))
        )
        # All of them before any is checked: none is left over for the next time.
        found = [await self._confirmation(command, command, value) for command, value in wanted.items()]
        for (command, value), confirmed in zip(wanted.items(), found, strict=True):
            self._check(command, value, confirmed)

    async def control(self, controls: list[tuple[Control, bool]]) -> None:
        """Send SET-CONTROL commands, one after the other where they must be confirmed. Raises LineDown."""
        command = telnet.Set.CONTROL
        for control, must in controls:
            value, line = bytes((control,)), _line_of(control)
            if must:
                self._expect(line)
            self._send(telnet.subnegotiation(command, value))
            if must:
                self._check(command, value, await self._confirmation(line, command, value))

    def attach(self, protocol: asyncio.Protocol, transport: Rfc2217Transport) -> None:
        """Pass everything to this protocol from now on. Raises LineDown if the connection was lost meanwhile."""
        if self._cause is not None:
            raise self._cause
        self._protocol, self._transport = protocol, transport
        self._byte_marked = taker_of_marked_bytes(protocol)
        # Bytes received before this are dropped: they may be a banner, or noise at another baud rate.
        protocol.connection_made(transport)

    def line_errors(self) -> DriverErrors | None:
        """Return the errors that the server has reported; None if it has never confirmed that it reports them."""
        if not self._errors_reported:
            return None
        count = self._errors
        return DriverErrors(
            count[LineError.FRAMING], count[LineError.PARITY], count[LineError.BREAK], count[LineError.OVERRUN], 0
        )

    def _expect(self, *keys: object) -> None:
        """Prepare for these replies before the request is sent."""
        for key in keys:
            self._waiting[key] = asyncio.get_running_loop().create_future()

    async def _confirmation(self, key: object, command: telnet.Set, value: bytes) -> bytes:
        hint = "set the port at the server, and use socket://"
        return await self._answer(key, f"confirm {telnet.value_text(command, value)}", hint)

    async def _answer(self, key: object, what: str, hint: str) -> bytes:
        if self._cause is not None:
            raise self._cause
        if key not in self._waiting:
            self._expect(key)
        try:
            async with asyncio.timeout(CONFIRM_DEADLINE):
                return await self._waiting[key]
        except TimeoutError:
            raise LineDown(f"{self._name} did not {what} within {CONFIRM_DEADLINE:g} s", hint=hint) from None
        finally:
            self._waiting.pop(key, None)

    def _check(self, command: telnet.Set, wanted: bytes, found: bytes) -> None:
        if found != wanted:
            what, instead = telnet.value_text(command, wanted), telnet.value_text(command, found)
            hint = "use settings that the server and its adapter have"
            # A server confirms the value that it has set, which is the nearest one that its hardware has.
            raise LineDown(f"{self._name} does not take {what}: it confirms {instead}", hint=hint)

    # what asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._tcp = cast("asyncio.Transport", transport)
        asked = ((WILL, COM_PORT), (WILL, BINARY), (DO, BINARY), (WILL, SUPPRESS_GO_AHEAD), (DO, SUPPRESS_GO_AHEAD))
        self._send(b"".join(telnet.negotiation(*each) for each in asked))

    def data_received(self, data: bytes) -> None:
        try:
            pieces = self._reader.take(data)
        except telnet.TelnetError as error:
            self._fail(LineDown(f"{self._name}: {error}", hint="check that the port speaks telnet with RFC 2217"))
            return
        # An error is reported before or behind its byte, as the server likes. So errors go first: they invalidate all
        # data of the same segment.
        for piece in pieces:
            if isinstance(piece, telnet.Subnegotiation) and piece.code == telnet.Notice.LINESTATE and piece.value:
                self._take_errors(LineError(piece.value[0] & telnet.LINE_ERRORS))
        for piece in pieces:
            if self._cause is not None:  # it is being aborted, and the bytes after the error cannot be trusted
                return
            if isinstance(piece, bytes):
                if self._protocol is not None:
                    self._protocol.data_received(piece)
            elif isinstance(piece, telnet.Negotiation):
                self._negotiate(piece.verb, piece.option)
            else:
                self._take_message(piece.code, piece.value)

    def pause_writing(self) -> None:
        if self._protocol is not None:
            self._protocol.pause_writing()

    def resume_writing(self) -> None:
        if self._protocol is not None:
            self._protocol.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        lost = LineDown(
            f"{self._name} closed the connection before its settings were confirmed",
            hint="another program may be connected to it; check how many connections the server allows",
        )
        cause = self._cause
        self._cause = cause or lost
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(self._cause)
                # Otherwise asyncio would log it as never retrieved.
                future.exception()  # it may be that none waits for it
        if self._protocol is not None:
            self._protocol.connection_lost(cause or exc)

    # inside

    def _send(self, data: bytes) -> None:
        if self._tcp is not None and not self._tcp.is_closing():
            self._tcp.write(data)

    def _fail(self, cause: LineDown) -> None:
        """Give up the connection: `connection_lost` reports the cause."""
        if self._cause is None and self._tcp is not None:
            self._cause = cause
            self._tcp.abort()

    def _negotiate(self, verb: int, option: int) -> None:
        if (verb, option) in AGREED:
            # A server may send DO and WILL in any order, and more than once.
            self._missing.discard((verb, option))
            if not self._missing:
                self._resolve(AGREEMENT, b"")
        elif (verb, option) in ((DONT, COM_PORT), (DONT, BINARY), (WONT, BINARY)):
            what = "RFC 2217 (telnet option 44)" if option == COM_PORT else "binary transmission (telnet option 0)"
            hint = "enable RFC 2217 for this port at the server (ser2net: telnet(rfc2217)), or use socket://"
            self._fail(LineDown(f"{self._name} refuses {what}", hint=hint))
        # Each option once: two sides that reply to each other's replies would never end (RFC 854).
        elif verb in (WILL, DO) and (verb, option) not in self._answered:
            self._answered.add((verb, option))
            # All other options are refused, as telnet requires of a side that does not know them.
            yes = (verb, option) == (WILL, COM_PORT)
            answer = (DO if yes else DONT) if verb == WILL else WONT
            self._send(telnet.negotiation(answer, option))

    def _take_message(self, code: int, value: bytes) -> None:
        match code:
            case telnet.Notice.MODEMSTATE if value:
                self.modem_lines = ModemLines(*(bool(value[0] & bit) for bit in (16, 32, 64, 128)))
            case telnet.Notice.LINESTATE | telnet.Notice.LINESTATE_MASK:
                self._errors_reported = True
            case telnet.Notice.SUSPEND | telnet.Notice.RESUME:
                # The server's buffer is full, or its port is stopped by flow control.
                self.suspended = code == telnet.Notice.SUSPEND
                if self._transport is not None:
                    self._transport.suspend(self.suspended)
            case _ if code == telnet.Set.CONTROL + telnet.FROM_SERVER and value:
                self._resolve(_line_of(value[0]), value)
            case _:
                self._resolve(code - telnet.FROM_SERVER, value)

    def _take_errors(self, errors: LineError) -> None:
        if not errors or self._protocol is None:
            return
        self._errors_reported = True
        for each in errors:
            self._errors[each] += 1
        # Without the byte: which one it was is not known.
        self._byte_marked(b"", Mark.BREAK if LineError.BREAK in errors else Mark.DAMAGED)

    def _resolve(self, key: object, value: bytes) -> None:
        future = self._waiting.get(key)
        if future is not None and not future.done():
            future.set_result(value)


def _line_of(control: int) -> str:
    """Return which line or mode a SET-CONTROL value is about: confirmations of several look alike otherwise."""
    if control in (Control.DTR_ON, Control.DTR_OFF):
        return "DTR"
    return "RTS" if control in (Control.RTS_ON, Control.RTS_OFF) else "flow control"
