"""One end of a WebSocket: whatever pieces its bytes come in, and whoever wrote them, the same messages are heard."""

from __future__ import annotations

import asyncio
import logging
import os
import random
import socket
import struct
import sys
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from websockets.client import ClientProtocol
from websockets.frames import Frame
from websockets.protocol import OPEN
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from busmaster.app.bounds import MOST_FRAMES, SEND_WITHIN
from busmaster.app.service import connection
from busmaster.app.service.connection import (
    Connection,
    IncomingConnection,
    OutgoingConnection,
    check_installed,
    new_key,
    origin_of,
    process_number,
    text_frame,
)
from busmaster.errors import InvalidCommand
from busmaster.testing import run_in_virtual_time
from tests.stories import in_virtual_time

LENGTHS = (0, 1, 125, 126, 127, 65535, 65536, 70000)
LONGEST = 100_000


class Ear:
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.heard_so_far: list[str | bytes] = []
        self.is_open = False
        self.is_over = False

    def delay(self, origin: object, process: int) -> float | None:
        return 0.0

    def refusal(self, _: object) -> None:
        return None

    def opened(self) -> None:
        self.is_open = True

    def received(self, message: str | bytes) -> None:
        self.heard_so_far.append(message)

    def writable(self) -> None:
        pass

    def lost(self) -> None:
        self.is_over = True


class Wire(asyncio.Transport):
    """Keeps what is written."""

    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()
        self.ended = False
        self.reads = True

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def write(self, data: Any) -> None:
        self.written += data

    def write_eof(self) -> None:
        self.ended = True

    def is_closing(self) -> bool:
        return False

    def is_reading(self) -> bool:
        return self.reads

    def abort(self) -> None:
        self.ended = True


def give(end: Connection, data: bytes, sizes: Callable[[], int]) -> None:
    """Have it read so many bytes at a time."""
    while data:
        buffer = end.get_buffer(-1)
        count = min(sizes(), len(buffer), len(data))
        buffer[:count] = data[:count]
        end.buffer_updated(count)
        data = data[count:]


def client() -> ClientProtocol:
    return ClientProtocol(parse_uri("ws://localhost/"))


def served(ear: Ear) -> tuple[IncomingConnection, Wire]:
    end, wire = IncomingConnection(ear, longest=LONGEST, read_at_once=512), Wire()
    end.connection_made(wire)
    return end, wire


def bytes_of(core: ClientProtocol | ServerProtocol) -> bytes:
    return b"".join(core.data_to_send())


def in_a_loop(story: Callable[[], None]) -> None:
    async def run() -> None:
        story()

    run_in_virtual_time(run())


@pytest.mark.parametrize("seed", range(20))
def test_messages_are_the_same_in_whatever_pieces_they_come(seed: int) -> None:
    chance = random.Random(seed)

    def story() -> None:
        ear, core, expected = Ear(), client(), list[str | bytes]()
        end, wire = served(ear)
        core.send_request(core.connect())
        data = bytes_of(core)  # and what follows does not wait for the answer
        core.state = OPEN
        for number in range(20):
            text = "\u00e4" * chance.choice((0, 1, 62, 63, 64, 300, 20_000)) + str(number)
            match chance.randrange(4):
                case 0:
                    core.send_text(text.encode()[:3], fin=False)
                    core.send_ping(b"between")
                    core.send_continuation(text.encode()[3:], fin=True)
                    expected.append(text)
                case 1:
                    core.send_binary(text.encode())
                    expected.append(text.encode())
                case 2:
                    core.send_pong(b"")
                case 3:
                    core.send_text(text.encode())
                    expected.append(text)
            data += bytes_of(core)
        core.send_close(1000)
        data += bytes_of(core)
        give(end, data, lambda: chance.choice((1, 2, 3, 7, 100, 512)))
        assert ear.is_open
        assert ear.heard_so_far == expected
        assert wire.ended
        assert wire.written.startswith(b"HTTP/1.1 101")

    in_a_loop(story)


@pytest.mark.parametrize("length", LENGTHS)
def test_what_is_said_is_what_the_library_reads_and_the_other_way_round(length: int) -> None:
    text = "x" * length
    server = ServerProtocol(state=OPEN, max_size=None)
    server.receive_data(text_frame(text.encode(), new_key()))
    asker = ClientProtocol(parse_uri("ws://localhost/"), state=OPEN, max_size=None)
    asker.receive_data(text_frame(text.encode(), b""))
    for core in (server, asker):
        [frame] = core.events_received()
        assert isinstance(frame, Frame)
        assert bytes(frame.data).decode() == text

    def story() -> None:
        ear = Ear()
        end, wire = served(ear)
        core = client()
        core.send_request(core.connect())
        give(end, bytes_of(core), lambda: 512)
        core.receive_data(bytes(wire.written))
        core.send_text(text.encode())
        give(end, bytes_of(core), lambda: 512)
        end.send(text.encode())
        assert ear.heard_so_far == [text]

    in_a_loop(story)


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (b"\x81\x01x", 1002),  # not masked
        (b"\xc1\x81\x00\x00\x00\x00x", 1002),  # with a reserved bit
        (b"\x80\x81\x00\x00\x00\x00x", 1002),  # goes on with nothing
        (b"\x01\x81\x00\x00\x00\x00x\x81\x81\x00\x00\x00\x00x", 1002),  # a text within another
        (b"\x81\x82\x00\x00\x00\x00\xff\xff", 1007),  # no UTF-8
        (b"\x81\xff" + (LONGEST + 20).to_bytes(8, "big"), 1009),
        (b"\x01\xfe\xff\xff" + bytes(4 + 65535) + b"\x80\xfe\xff\xff" + bytes(4 + 65535), 1009),
    ],
    ids=range(7),
)
def test_what_is_no_message_ends_the_connection_with_its_code(frame: bytes, code: int) -> None:
    def story() -> None:
        ear, core = Ear(), client()
        end, wire = served(ear)
        core.send_request(core.connect())
        give(end, bytes_of(core), lambda: 512)
        wire.written.clear()
        give(end, frame + frame, lambda: 512)
        assert wire.written[0] == 0x88
        assert int.from_bytes(wire.written[2:4], "big") == code
        assert wire.ended
        assert ear.heard_so_far == []

    in_a_loop(story)


def test_one_that_is_silent_between_two_pings_is_let_go_and_one_that_is_not_read_is_not() -> None:
    async def run(read: Sequence[bool]) -> bool:
        ear, core = Ear(), client()
        end, wire = served(ear)
        core.send_request(core.connect())
        give(end, bytes_of(core), lambda: 512)
        for wire.reads in read:
            await asyncio.sleep(connection.PING_EVERY + 0.1)
        return wire.ended

    assert run_in_virtual_time(run([True, True]))
    assert not run_in_virtual_time(run([True]))
    assert not run_in_virtual_time(run([True, False, False]))


def test_one_who_asks_hears_why_it_is_refused() -> None:
    def story() -> None:
        ear, wire = Ear(), Wire()
        end = OutgoingConnection(ear, masks=True, longest=LONGEST, read_at_once=512)
        end.connection_made(wire)
        give(end, b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 3\r\n\r\nno\n", lambda: 7)
        end.eof_received()
        assert not ear.is_open
        assert "503" in (end.complaint or "")

    in_a_loop(story)


def test_a_peer_that_has_gone_before_it_was_accepted_has_no_origin() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        client = socket.create_connection(server.getsockname())
        accepted, _ = server.accept()
        with accepted:
            assert origin_of(accepted) == "127.0.0.1"
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            client.close()  # it resets the connection
            with pytest.raises(ConnectionResetError):
                accepted.recv(1)
            assert origin_of(accepted) is None
    assert origin_of(None) is None


# a connection that is slow, ends, or does not begin


class Host(Ear):
    """A handler that delays or refuses a connection, and counts how often it is writable again."""

    def __init__(self, delay: float | None = 0.0) -> None:
        super().__init__()
        self._delay = delay
        self.writables = 0

    def delay(self, origin: object, process: int) -> float | None:
        return self._delay

    def writable(self) -> None:
        self.writables += 1


class SlowWire(Wire):
    """A wire of which reading can be paused, and that can be closing."""

    def __init__(self) -> None:
        super().__init__()
        self.closing = False
        self.limit: int | None = None

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        self.limit = high

    def is_closing(self) -> bool:
        return self.closing

    def pause_reading(self) -> None:
        self.reads = False

    def resume_reading(self) -> None:
        self.reads = True


def opened_by(host: Host) -> tuple[IncomingConnection, SlowWire, ClientProtocol]:
    end, wire, core = IncomingConnection(host, longest=LONGEST, read_at_once=512), SlowWire(), client()
    end.connection_made(wire)
    core.send_request(core.connect())
    give(end, bytes_of(core), lambda: 512)
    core.receive_data(bytes(wire.written))
    wire.written.clear()
    return end, wire, core


def events(core: ClientProtocol, wire: Wire) -> list[Any]:
    core.receive_data(bytes(wire.written))
    wire.written.clear()
    return [event for event in core.events_received() if isinstance(event, Frame)]


@in_virtual_time
async def test_a_peer_that_takes_its_messages_late_stays_and_one_that_never_does_is_disconnected() -> None:
    host = Host()
    end, wire, _ = opened_by(host)
    for _ in range(2):
        end.pause_writing()
        assert end.full
        await asyncio.sleep(SEND_WITHIN / 2)
        end.resume_writing()
    assert (end.full, host.writables) == (False, 2)
    end.buffer_updated(0)  # it still sends
    await asyncio.sleep(SEND_WITHIN)
    assert [wire.ended] == [False]
    end.pause_writing()
    await asyncio.sleep(SEND_WITHIN + 0.1)
    assert [wire.ended] == [True]


@in_virtual_time
async def test_nothing_is_sent_before_a_connection_is_open_or_when_it_is_closing() -> None:
    host, wire = Host(), SlowWire()
    end = IncomingConnection(host, longest=LONGEST, read_at_once=512)
    end.resume()
    end.send(b"early")
    end.connection_made(wire)
    end.send(b"early")
    assert wire.written == b""
    end, wire, core = opened_by(host)
    assert wire.limit == 0  # `pause_writing` is called as soon as a byte waits
    wire.closing = True
    end.send(b"late")
    give(end, b"\x89\x80" + bytes(4), lambda: 512)  # a ping, which gets no reply any more
    assert wire.written == b""
    wire.closing = False
    end.close(1001, "the owner ends")
    end.send(b"late")
    [frame] = events(core, wire)
    assert (core.close_rcvd and (core.close_rcvd.code, core.close_rcvd.reason)) == (1001, "the owner ends")
    assert frame.opcode == 8
    await asyncio.sleep(connection.CLOSE_WITHIN / 2)
    assert [wire.ended] == [False]
    end.close(1001, "again")
    await asyncio.sleep(connection.CLOSE_WITHIN / 2 + 0.01)
    assert [wire.ended] == [True]  # the other end did not agree in time


@in_virtual_time
async def test_a_connection_that_is_closed_before_it_is_open_ends_at_once() -> None:
    end, wire = IncomingConnection(Host(), longest=LONGEST, read_at_once=512), SlowWire()
    end.close()
    assert [wire.ended] == [False]
    end.connection_made(wire)
    assert [wire.ended] == [True]
    end, wire = IncomingConnection(Host(), longest=LONGEST, read_at_once=512), SlowWire()
    end.connection_made(wire)
    end.close()
    assert [wire.ended] == [True]


@in_virtual_time
async def test_the_end_of_a_connection_is_reported_and_stops_its_timers() -> None:
    host = Host()
    end, wire, _ = opened_by(host)
    end.pause_writing()
    end.connection_lost(None)
    await end.closed()
    assert host.is_over
    await asyncio.sleep(connection.PING_EVERY + SEND_WITHIN)
    assert (wire.ended, bytes(wire.written)) == (False, b"")
    end.send(b"late")
    assert wire.written == b""


@in_virtual_time
async def test_a_delayed_connection_is_read_after_its_delay_and_a_refused_one_is_closed() -> None:
    wire = SlowWire()
    IncomingConnection(Host(0.5), longest=LONGEST, read_at_once=512).connection_made(wire)
    assert [wire.reads] == [False]
    await asyncio.sleep(0.49)
    assert [wire.reads] == [False]
    await asyncio.sleep(0.02)
    assert [wire.reads] == [True]
    for delay, ended in ((0.0, False), (None, True)):
        wire = SlowWire()
        IncomingConnection(Host(delay), longest=LONGEST, read_at_once=512).connection_made(wire)
        assert (wire.reads, wire.ended) == (True, ended)


@in_virtual_time
async def test_a_message_has_at_most_the_longest_length() -> None:
    for length, code in ((LONGEST, None), (LONGEST + 1, 1009)):
        host = Host()
        end, wire, core = opened_by(host)
        give(end, text_frame(b"x" * length, new_key()), lambda: 512)
        events(core, wire)
        assert [len(message) for message in host.heard_so_far] == ([length] if code is None else [])
        assert (core.close_rcvd and core.close_rcvd.code) == code


@in_virtual_time
async def test_pings_are_limited_in_each_second_anew() -> None:
    ping = b"\x89\x80" + bytes(4)
    end, wire, core = opened_by(Host())
    for _ in range(3):
        give(end, ping * MOST_FRAMES, lambda: 512)
        assert len(events(core, wire)) == MOST_FRAMES
        await asyncio.sleep(1.0)
    give(end, ping * (MOST_FRAMES + 1), lambda: 512)
    events(core, wire)
    assert core.close_rcvd is not None
    assert core.close_rcvd.code == 1008
    assert [wire.reads] == [False]


@in_virtual_time
async def test_a_peer_that_answers_each_ping_stays() -> None:
    end, wire, core = opened_by(Host())
    for _ in range(5):
        await asyncio.sleep(connection.PING_EVERY + 0.1)
        assert [frame.opcode for frame in events(core, wire)] == [9]
        give(end, bytes_of(core), lambda: 512)
        assert [wire.ended] == [False]


def refused_with(reply: bytes) -> OutgoingConnection:
    end = OutgoingConnection(Ear(), masks=True, token="secret", longest=LONGEST, read_at_once=512)
    wire = Wire()
    end.connection_made(wire)
    assert b"Authorization: Bearer secret\r\n" in wire.written
    assert (end.status, end.refusal, end.complaint, end.close_reason, end.owner_ended) == (None, "", None, "", False)
    give(end, reply, lambda: 512)
    end.eof_received()
    return end


@pytest.mark.parametrize(
    ("body", "text"),
    [(b" no place \n", "no place"), (b"x" * 400, "x" * 300), (b"\x1b[2J", ""), (b"\xff", "\ufffd"), (b"", "")],
)
def test_the_text_of_a_refusal_is_cut_and_can_be_printed(body: bytes, text: str) -> None:
    def story() -> None:
        head = b"HTTP/1.1 429 Too Many Requests\r\nContent-Length: %d\r\n\r\n" % len(body)
        end = refused_with(head + body)
        assert (end.status, end.refusal) == (429, text)

    in_a_loop(story)


@pytest.mark.parametrize(("code", "ended"), [(1000, False), (1001, True), (1008, False)])
def test_the_other_end_closes_with_a_reason(code: int, ended: bool) -> None:
    def story() -> None:
        end, wire = OutgoingConnection(Ear(), masks=False, longest=LONGEST, read_at_once=512), Wire()
        end.connection_made(wire)
        assert b"Authorization" not in wire.written
        core = ServerProtocol()
        core.receive_data(bytes(wire.written))
        [request] = core.events_received()
        core.send_response(core.accept(request))  # type: ignore[arg-type]  # the first event is a request
        core.send_close(code, "it is over")
        give(end, bytes_of(core), lambda: 512)
        assert (end.close_reason, end.owner_ended) == ("it is over", ended)

    in_a_loop(story)


def test_the_kernel_names_the_process_and_the_user_of_a_unix_socket_only() -> None:
    one, other = socket.socketpair()
    with one, other:
        assert (process_number(one), origin_of(one)) == (os.getpid(), os.getuid())
    assert (process_number(one), origin_of(one)) == (0, None)  # closed
    assert process_number(None) == 0
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert process_number(server) == 0


def test_the_origin_of_a_program_on_this_machine_is_its_user_and_not_its_group() -> None:
    """On many machines both have the same number, for example for root."""
    credentials = struct.pack("3i", 4711, 1000, 50)
    connected: Any = SimpleNamespace(family=socket.AF_UNIX, getsockopt=lambda *_: credentials)
    assert (process_number(connected), origin_of(connected)) == (4711, 1000)


def test_a_peer_of_ipv6_is_its_network() -> None:
    connected: Any = SimpleNamespace(family=socket.AF_INET6, getpeername=lambda: ("2001:db8::7", 1, 0, 0))
    assert origin_of(connected) == "2001:db8::/64"


@pytest.mark.parametrize("name", ["msgspec", "websockets"])
def test_a_missing_package_is_named_with_the_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name if name == "msgspec" else "websockets.client", None)
    with pytest.raises(InvalidCommand, match=rf"sharing a line needs {name}; pip install 'busmaster\[service\]'"):
        check_installed()


def test_the_library_reports_nothing_to_the_users_log() -> None:
    log = connection._quiet()
    assert not log.propagate
    assert connection._quiet() is log
    assert [type(handler) for handler in log.handlers].count(logging.NullHandler) == 1
