"""One end of a WebSocket: whatever pieces its bytes come in, and whoever wrote them, the same messages are heard."""

from __future__ import annotations

import asyncio
import random
import socket
import struct
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from websockets.client import ClientProtocol
from websockets.frames import Frame
from websockets.protocol import OPEN
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from busmaster.app.service import connection
from busmaster.app.service.connection import Connection, IncomingConnection, OutgoingConnection, origin_of
from busmaster.app.service.frames import new_key, text_frame
from busmaster.testing import run_in_virtual_time

LENGTHS = (0, 1, 125, 126, 127, 65535, 65536, 70000)
LONGEST = 100_000


class Ear:
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.heard_so_far: list[str | bytes] = []
        self.is_open = False
        self.is_over = False

    def delay(self, origin: object, process: int) -> float:
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
