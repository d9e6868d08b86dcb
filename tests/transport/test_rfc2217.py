"""Rfc2217Port against pyserial's own server logic, and against servers that do not keep to the standard."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from busmaster import Bus, GarbledReply, Hcp2Controller, MscController, ext
from busmaster.arbiter.counters import DriverErrors, Mark
from busmaster.contract.profile import LineSettings
from busmaster.contract.tap import Attempt
from busmaster.emulator.line import Line
from busmaster.errors import InvalidCommand, LineDown
from busmaster.registry import make_device
from busmaster.transport import rfc2217
from busmaster.transport.endpoints import is_paced
from busmaster.transport.kernel import open_port
from busmaster.transport.rfc2217 import ModemLines, Rfc2217Port, Rfc2217Transport
from tests.patience import PATIENCE
from tests.transport.fakes import Recorder
from tests.transport.rfc2217_server import RemotePort, Server, Session, rfc2217_server

AGREES = "ff fd 2c ff fd 00 ff fb 00"
CONFIRMS = "ff fa 2c 65 00 00 e1 00 ff f0 ff fa 2c 66 08 ff f0 ff fa 2c 67 01 ff f0 ff fa 2c 68 01 ff f0"
"""A server's answers to 57600 baud, 8N1."""


class Marked(Recorder):
    """Notes data and errors in order."""

    def __init__(self) -> None:
        super().__init__()
        self.pieces: list[bytes | Mark] = []

    def data_received(self, data: bytes) -> None:
        self.pieces.append(data)
        super().data_received(data)

    def byte_marked(self, byte: bytes, mark: Mark) -> None:
        assert byte == b""
        self.pieces.append(mark)
        super().data_received(b"")


async def opened(number: int, recorder: Recorder | None = None, **options: Any) -> tuple[Rfc2217Transport, Recorder]:
    recorder = recorder or Recorder()
    port = Rfc2217Port("127.0.0.1", number, **({"baudrate": 57600} | options))
    transport = await port.open(lambda: recorder)
    return transport, recorder


async def closed(transport: asyncio.Transport, recorder: Recorder) -> None:
    transport.close()
    await recorder.lost()
    assert recorder.losses == [None]


async def until(server: Server, condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():
            server.changed.clear()
            await server.changed.wait()


@asynccontextmanager
async def scripted(*says: str) -> AsyncIterator[tuple[int, list[bytes], list[asyncio.StreamWriter]]]:
    """A server that sends one piece, in hexadecimal, for each that it receives, whatever that is."""
    heard: list[bytes] = []
    writers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        left = list(says)
        while data := await reader.read(4096):
            heard.append(data)
            if left:
                writer.write(bytes.fromhex(left.pop(0)))
        writer.close()

    listening = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield listening.sockets[0].getsockname()[1], heard, writers
    finally:
        listening.close()
        for writer in writers:
            writer.close()
        await listening.wait_closed()


# -- what it is ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"host": ""}, "host"),
        ({"port": 0}, "1 to 65535"),
        ({"baudrate": 0}, "baudrate"),
        ({"baudrate": 2**32}, "RFC 2217 has baud rates up to"),
        ({"parity": "X"}, "framing"),
        ({"stopbits": 3}, "framing"),
        ({"receive_latency": -1.0}, "receive_latency"),
        ({"rtscts": True, "rts": True}, "exclude each other"),
        ({"rtscts": True, "rts": False}, "exclude each other"),
    ],
)
def test_values_that_no_port_can_have_are_rejected_when_it_is_built(values: dict[str, Any], says: str) -> None:
    values = {"host": "server", "port": 4001, "baudrate": 9600, **values}
    with pytest.raises(InvalidCommand, match=says):
        Rfc2217Port(**values)


def test_it_has_the_framing_that_it_sets() -> None:
    port = Rfc2217Port("server", 4001, baudrate=9600, bytesize=7, parity="E")
    assert port.settings == LineSettings(9600, 7, "E")
    assert Rfc2217Port("server", 4001, baudrate=2**32 - 1).settings.baudrate == 2**32 - 1
    assert port.name == "server:4001"


# -- with pyserial's server ------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_the_remote_port_is_set_and_bytes_go_both_ways_unchanged() -> None:
    async with rfc2217_server(banner=b"welcome\xff\xf1\r\n") as server:
        options: dict[str, Any] = {
            "baudrate": 65280,
            "bytesize": 7,
            "parity": "E",
            "stopbits": 1.5,
            "dtr": False,
            "rts": False,
        }
        transport, recorder = await opened(server.number, **options)
        port = server.port
        assert (port.baudrate, port.bytesize, port.parity, port.stopbits) == (65280, 7, "E", 1.5)
        assert (port.dtr, port.rts, port.rtscts, port.xonxoff) == (False, False, False, False)
        assert recorder.connections == 1
        assert not is_paced(Rfc2217Port("127.0.0.1", server.number, baudrate=9600), transport)
        every = bytes(range(256)) * 2 + b"\xff\xff\r\n\r\0"
        session = server.sessions[0]
        transport.write(every)
        await until(server, lambda: session.received == every)
        session.say(every)
        await recorder.until(lambda r: len(r.received) == len(every))
        assert recorder.received == every
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_rtscts_is_set_at_the_server() -> None:
    async with rfc2217_server() as server:
        await closed(*await opened(server.number, rtscts=True))
        assert server.port.rtscts


@pytest.mark.asyncio
async def test_flow_control_that_an_earlier_client_left_on_is_switched_off() -> None:
    port = RemotePort()
    port.rtscts = True
    async with rfc2217_server(port=port) as server:
        transport, recorder = await opened(server.number)
        transport.write(b"x")
        await until(server, lambda: server.sessions[0].received == b"x")
        assert not server.port.rtscts
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_dtr_and_rts_are_left_alone_unless_asked_for() -> None:
    port = RemotePort(lambda name, _: name not in ("dtr", "rts"))  # it would raise
    async with rfc2217_server(port=port) as server:
        await closed(*await opened(server.number))


@pytest.mark.asyncio
async def test_dtr_and_rts_are_switched_on_each_by_its_own_option() -> None:
    tried: list[dict[str, Any]] = [{"dtr": True}, {"rts": True}, {"dtr": True, "rts": False}]
    for options in (*tried, {"rtscts": True, "dtr": False}):
        port = RemotePort()
        port.dtr, port.rts = not options.get("dtr"), not options.get("rts")
        others = {name: getattr(port, name) for name in ("dtr", "rts") if name not in options}
        async with rfc2217_server(port=port) as server:
            await closed(*await opened(server.number, **options))
        assert {name: getattr(port, name) for name in ("dtr", "rts")} == {
            **others,
            **{name: on for name, on in options.items() if name != "rtscts"},
        }
        assert port.rtscts is options.get("rtscts", False)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("baudrate", "does not take 57600 baud: it confirms 1200 baud; use settings that the server"),
        ("bytesize", "does not take 7 data bits: it confirms 8 data bits"),
        ("parity", "does not take parity E: it confirms parity N"),
        ("stopbits", "does not take stop bits 2: it confirms stop bits 1"),
    ],
)
@pytest.mark.asyncio
async def test_a_server_that_confirms_another_setting_is_an_error_that_says_so(name: str, says: str) -> None:
    async with rfc2217_server(port=RemotePort(lambda changed, _: changed != name)) as server:
        with pytest.raises(LineDown, match=rf"^127.0.0.1:{server.number} {says}"):
            await opened(server.number, bytesize=7, parity="E", stopbits=2)


@pytest.mark.asyncio
async def test_an_open_port_can_be_tuned_and_survives_a_rate_that_the_server_does_not_take() -> None:
    async with rfc2217_server(port=RemotePort(lambda _, value: value != 4800)) as server:
        transport, recorder = await opened(server.number)
        await transport.tune(LineSettings(9600, 7, "E"))
        assert (server.port.baudrate, server.port.bytesize, server.port.parity) == (9600, 7, "E")
        with pytest.raises(LineDown, match="does not take 4800 baud: it confirms 9600 baud"):
            await transport.tune(LineSettings(4800))
        await transport.tune(LineSettings(19200))
        assert server.port.baudrate == 19200
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_modem_lines_are_those_that_the_server_reported_last() -> None:
    async with rfc2217_server() as server:
        transport, recorder = await opened(server.number)
        assert transport.get_extra_info("modem_lines") == ModemLines(cts=True, dsr=True, ri=False, cd=False)
        server.sessions[0].report_modem(0xFF)  # its value 255 is doubled
        server.sessions[0].report_modem(0b1001_0000)
        server.sessions[0].say(b"x")
        await recorder.heard(b"x")
        assert transport.get_extra_info("modem_lines") == ModemLines(cts=True, dsr=False, ri=False, cd=True)
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_line_errors_are_marked_ahead_of_all_data_of_their_segment_and_counted_by_kind() -> None:
    async with rfc2217_server() as server:
        transport, recorder = await opened(server.number, Marked())
        assert isinstance(recorder, Marked)
        assert server.sessions[0].manager.linstate_mask == 0b11110
        port = open_port(transport)
        assert port.errors() is None  # pyserial's server does not confirm the mask
        transport.pause_reading()
        session = server.sessions[0]
        for part in (b"a", 4, b"b", 8, 2, 16 | 8, 64 | 1, b"c"):
            session.say(part) if isinstance(part, bytes) else session.manager.rfc2217_send_subnegotiation(
                b"\x6a", bytes((part,))
            )
        transport.resume_reading()
        await recorder.heard(b"c")
        assert recorder.pieces == [*[Mark.DAMAGED] * 3, Mark.BREAK, b"a", b"b", b"c"]
        assert port.errors() == DriverErrors(framing=2, parity=1, breaks=1, overruns=1, buffer_overruns=0)
        port.reset()
        assert port.errors() == DriverErrors(0, 0, 0, 0, 0)
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_output_that_the_server_suspends_is_held_and_sent_in_order() -> None:
    async with rfc2217_server() as server:
        transport, recorder = await opened(server.number)
        session = server.sessions[0]
        session.manager.rfc2217_send_subnegotiation(b"\x6c")
        session.say(b"1")
        await recorder.heard(b"1")
        transport.write(b"a\xff")
        transport.write(b"b")
        assert recorder.flow == ["pause", "pause"]
        assert open_port(transport).unsent(0.0) == 4
        assert session.received == b""
        session.manager.rfc2217_send_subnegotiation(b"\x6d")
        await until(server, lambda: session.received == b"a\xffb")
        assert recorder.flow[2:] == ["resume"]
        assert transport.get_write_buffer_size() == 0
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_output_that_the_network_does_not_take_pauses_the_protocol_and_is_dropped_by_an_abort(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with scripted(AGREES, CONFIRMS) as (number, _, writers):
        transport, recorder = await opened(number)
        server: Any = writers[0].transport
        for stops, size in ((1, 1_000_000), (2, 40_000_000)):  # the second is more than the kernel ever takes
            with monkeypatch.context() as patch:
                patch.setattr(server, "resume_reading", lambda: None)  # its stream would do so
                server.pause_reading()
                while recorder.flow.count("pause") < stops:
                    transport.write(bytes(size))
                assert transport.get_write_buffer_size() > 0
                if stops == 2:
                    transport.abort()
                    async with asyncio.timeout(PATIENCE / 10):
                        await recorder.lost()
            server.resume_reading()
            if stops == 1:
                await recorder.until(lambda r: r.flow == ["pause", "resume"])
                assert transport.get_write_buffer_size() == 0
        assert recorder.losses == [None]


class Chunks:
    """A tap that keeps what was received at a time."""

    def __init__(self) -> None:
        self.heard: list[bytes] = []

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None: ...

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.heard.append(data)

    def attempted(self, attempt: Attempt, /) -> None: ...


@pytest.mark.asyncio
async def test_a_reply_with_a_remote_parity_error_fails_the_attempt_and_is_counted() -> None:
    line = Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False)
    async with rfc2217_server(line) as server:

        def spoil(session: Session, data: bytes) -> None:
            server.spoil = lambda session, data: session.say(data)
            session.report(4)
            session.say(data)

        server.spoil = spoil
        async with Bus(Rfc2217Port("127.0.0.1", server.number, baudrate=57600)) as bus:
            axis, tap = Hcp2Controller(bus, 5), Chunks()
            ext.add_tap(bus, tap)
            with pytest.raises(GarbledReply, match="parity"):
                await axis.read(1, retries=0)
            assert all(tap.heard), "an error without a byte is no received byte"
            assert await axis.read(1) == 0
            counts = await bus.statistics()
            assert (counts.damaged, counts.breaks) == (1, 0)
            assert counts.driver == DriverErrors(framing=0, parity=1, breaks=0, overruns=0, buffer_overruns=0)
            bus.reset_statistics()
            assert (await bus.statistics()).driver == DriverErrors(0, 0, 0, 0, 0)


@pytest.mark.slow
@pytest.mark.asyncio
async def test_binary_data_full_of_ff_comes_through() -> None:
    line = Line(MscController.profile.line, [make_device("msc", 3)], paced=False)
    async with rfc2217_server(line) as server, Bus(Rfc2217Port("127.0.0.1", server.number, baudrate=9600)) as bus:
        press = MscController(bus, 3)
        for value in (-1, 0x00FF00FF, -65281, 0xFF):
            await press.write(2008, value)
            assert await press.read(2008) == value


@pytest.mark.asyncio
async def test_a_lost_connection_is_made_again_and_the_port_set_again() -> None:
    line = Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False)
    async with rfc2217_server(line) as server, Bus(Rfc2217Port("127.0.0.1", server.number, baudrate=57600)) as bus:
        axis = Hcp2Controller(bus, 5)
        assert await axis.read(1) == 0
        server.port.baudrate = 1200
        tcp = server.sessions[0].tcp
        assert tcp is not None
        tcp.abort()
        await until(server, lambda: len(server.sessions) == 2 and server.port.baudrate == 57600)
        async with asyncio.timeout(PATIENCE):
            while True:
                try:
                    assert await axis.read(1) == 0
                    break
                except LineDown:
                    await asyncio.sleep(0.01)


# -- with servers of other kinds -------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_a_server_that_answers_no_masks_and_no_flow_control_is_used() -> None:
    async with scripted(AGREES + "ff fb 03 ff fd 03", CONFIRMS) as (number, heard, _):
        transport, recorder = await opened(number)
        assert transport.get_extra_info("modem_lines") is None
        assert heard[0] == bytes.fromhex("ff fb 2c ff fb 00 ff fd 00 ff fb 03 ff fd 03")
        assert heard[1].startswith(bytes.fromhex("ff fa 2c 01")), "it does not answer agreements (RFC 854)"
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_server_that_suspends_while_the_port_is_opened_gets_no_byte_until_it_resumes() -> None:
    async with scripted(AGREES, CONFIRMS + "ff fa 2c 6c ff f0") as (number, heard, writers):
        transport, recorder = await opened(number)
        transport.write(b"a")
        assert recorder.flow == ["pause"]
        assert transport.get_write_buffer_size() == 1
        writers[0].write(bytes.fromhex("ff fa 2c 6c ff f0") + b"x")  # once more
        await recorder.heard(b"x")
        assert transport.get_write_buffer_size() == 1
        writers[0].write(bytes.fromhex("ff fa 2c 6d ff f0"))
        await recorder.until(lambda r: r.flow == ["pause", "resume"])
        transport.write(b"b")
        async with asyncio.timeout(PATIENCE):
            while not heard[-1].endswith(b"b"):  # noqa: ASYNC110  # the server has no event for it
                await asyncio.sleep(0.001)
        assert b"".join(heard).endswith(b"ab")
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_errors_are_counted_from_the_opening_where_the_server_reports_them() -> None:
    before = "ff fa 2c 6a 10 ff f0"
    async with scripted(AGREES, CONFIRMS + before + "ff fa 2c 6e 1e ff f0") as (number, _, writers):
        transport, recorder = await opened(number, Marked())
        port = open_port(transport)
        writers[0].write(bytes.fromhex("ff fa 2c 6a 60 ff f0") + b"x")  # its transmitter is empty: not an error
        await recorder.heard(b"x")
        assert port.errors() == DriverErrors(0, 0, 0, 0, 0)
        writers[0].write(bytes.fromhex("ff fa 2c 6a 10 ff f0") + b"y")
        await recorder.heard(b"y")
        assert port.errors() == DriverErrors(framing=0, parity=0, breaks=1, overruns=0, buffer_overruns=0)
        await closed(transport, recorder)


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("ff fe 2c", r"refuses RFC 2217 \(telnet option 44\); enable RFC 2217 for this port"),
        ("ff fd 2c ff fe 00", r"refuses binary transmission \(telnet option 0\)"),
        ("ff fd 2c ff fd 00 ff fc 00", r"refuses binary transmission \(telnet option 0\)"),
        ("ff fa 2c" + " 00" * 300, "longer than 256 bytes; check that the port speaks telnet"),
    ],
)
@pytest.mark.asyncio
async def test_a_server_that_cannot_be_used_is_an_error_that_says_why(answer: str, says: str) -> None:
    async with scripted(answer) as (number, _, writers):
        with pytest.raises(LineDown, match=says):
            await opened(number)
        assert await asyncio.wait_for(_ended(writers), PATIENCE)


async def _ended(writers: list[asyncio.StreamWriter]) -> bool:
    """Return when the client has closed its connection."""
    while not all(writer.is_closing() for writer in writers):  # noqa: ASYNC110  # a stream has no event for it
        await asyncio.sleep(0.001)
    return True


@pytest.mark.parametrize(
    ("answers", "says"),
    [
        ((), "did not agree to RFC 2217 within 0.05 s; .* for raw TCP use socket://"),
        ((AGREES.replace("ff fd 00", ""),), "did not agree to RFC 2217 within"),
        ((AGREES,), "did not confirm 57600 baud within 0.05 s; set the port at the server"),
        ((AGREES, CONFIRMS[:-21]), "did not confirm stop bits 1 within"),
    ],
)
@pytest.mark.asyncio
async def test_a_server_that_does_not_answer_is_given_up(
    answers: tuple[str, ...], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rfc2217, "CONFIRM_DEADLINE", 0.05)
    async with scripted(*answers) as (number, _, writers):
        with pytest.raises(LineDown, match=says):
            await opened(number)
        assert await asyncio.wait_for(_ended(writers), PATIENCE)


@pytest.mark.asyncio
async def test_dtr_that_is_not_confirmed_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rfc2217, "CONFIRM_DEADLINE", 0.05)
    async with scripted(AGREES, CONFIRMS + "ff fa 2c 69 01 ff f0 ff fa 2c 69 0c ff f0") as (number, _, _):
        with pytest.raises(LineDown, match="did not confirm DTR ON within"):
            await opened(number, dtr=True)
    async with scripted(AGREES, CONFIRMS, "ff fa 2c 69 01 ff f0 ff fa 2c 69 09 ff f0") as (number, _, _):
        with pytest.raises(LineDown, match="does not take DTR ON: it confirms DTR OFF"):
            await opened(number, dtr=True)


@pytest.mark.parametrize(
    ("options", "answer", "says"),
    [
        ({"rtscts": True}, "ff fa 2c 69 01 ff f0", "does not take RTS CTS: it confirms NO FLOW CONTROL"),
        (
            {"rts": False},
            "ff fa 2c 69 01 ff f0 ff fa 2c 69 0b ff f0",
            "does not take RTS OFF: it confirms RTS ON",
        ),
        ({"rtscts": True}, "ff fa 2c 69 03 ff f0 ff fc 00", "refuses binary transmission"),
    ],
)
@pytest.mark.asyncio
async def test_a_server_that_does_not_control_the_lines_as_set_or_refuses_in_the_end_is_not_used(
    options: dict[str, Any], answer: str, says: str
) -> None:
    recorder = Recorder()
    async with scripted(AGREES, CONFIRMS, answer) as (number, _, writers):
        with pytest.raises(LineDown, match=says):
            await opened(number, recorder, **options)
        assert await asyncio.wait_for(_ended(writers), PATIENCE)
    assert recorder.connections == 0


@pytest.mark.asyncio
async def test_a_change_of_settings_ends_only_when_the_server_has_answered_all_of_it() -> None:
    """An answer that is left over would be taken for that to the next change."""
    async with scripted(AGREES, CONFIRMS, "ff fa 2c 69 01 ff f0", "ff fa 2c 65 00 00 e1 00 ff f0 78") as (
        number,
        heard,
        writers,
    ):
        transport, recorder = await opened(number)
        async with asyncio.timeout(PATIENCE):
            while len(heard) < 3:  # noqa: ASYNC110  # the server has no event for it
                await asyncio.sleep(0.001)
        tuning = asyncio.ensure_future(transport.tune(LineSettings(9600)))
        await recorder.heard(b"x")
        assert not (await asyncio.wait([tuning], timeout=0.02))[0]
        writers[0].write(bytes.fromhex("ff fa 2c 66 08 ff f0 ff fa 2c 67 01 ff f0 ff fa 2c 68 01 ff f0"))
        with pytest.raises(LineDown, match="does not take 9600 baud: it confirms 57600 baud"):
            await tuning
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_server_that_closes_at_once_is_said_to_be_taken_perhaps() -> None:
    async def refuse(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"Port already in use\r\n")
        writer.close()

    listening = await asyncio.start_server(refuse, "127.0.0.1", 0)
    with pytest.raises(LineDown, match=r"closed the connection before .* another program may be connected"):
        await opened(listening.sockets[0].getsockname()[1])
    listening.close()


@pytest.mark.asyncio
async def test_options_that_are_proposed_again_and_again_are_refused_once() -> None:
    proposals = "ff fb 01 ff fd 1f ff fb 2c" * 1000
    async with scripted(AGREES + proposals, CONFIRMS) as (number, heard, writers):
        transport, recorder = await opened(number)
        writers[0].write(bytes.fromhex(proposals) + b"x")
        await recorder.heard(b"x")
        await closed(transport, recorder)
        said = b"".join(heard)
        assert [said.count(bytes.fromhex(answer)) for answer in ("ff fe 01", "ff fc 1f", "ff fd 2c")] == [1, 1, 1]


@pytest.mark.parametrize(
    ("says", "cause"),
    [("ff fc 00 61", "refuses binary transmission"), ("ff fa 2c ff fb 00", "is broken off by another")],
)
@pytest.mark.asyncio
async def test_a_server_that_breaks_the_rules_later_loses_the_line_with_the_cause(says: str, cause: str) -> None:
    async with scripted(AGREES, CONFIRMS) as (number, _, writers):
        _, recorder = await opened(number)
        writers[0].write(bytes.fromhex(says))
        await recorder.lost()
        assert cause in str(recorder.losses[0])
        assert recorder.received == b""


@pytest.mark.asyncio
async def test_a_confirmation_that_nobody_waits_for_changes_nothing() -> None:
    stray = "ff fa 2c 65 00 00 25 80 ff f0 ff fa 2c 90 ff f0 ff fa 2c 69 ff f0 ff fa 2c 6a ff f0"
    async with scripted(stray + AGREES, CONFIRMS) as (number, _, writers):
        transport, recorder = await opened(number)
        writers[0].write(bytes.fromhex(stray) + b"x")
        await recorder.heard(b"x")
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_cancelled_opening_closes_its_connection() -> None:
    async with scripted(AGREES) as (number, heard, writers):
        opening = asyncio.ensure_future(opened(number))
        async with asyncio.timeout(PATIENCE):
            while len(heard) < 2:  # noqa: ASYNC110  # it has agreed, and waits for the settings
                await asyncio.sleep(0.001)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        assert await asyncio.wait_for(_ended(writers), PATIENCE)
