"""MemoryPort: an emulated line under the real loop and under one that keeps virtual time."""

from __future__ import annotations

import asyncio
import time

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.memory import MemoryPort, MemoryTransport
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport.endpoints import is_paced
from tests.transport.fakes import Recorder

SETTINGS = LineSettings(9600)
TAU = SETTINGS.byte_time


class Parrot(Device):
    """Answers each ENQ."""

    answer = b"pong"

    def hear_byte(self, byte: int, now: float) -> None:
        self.attentive = True
        if byte == 0x05:
            self.reply(self.answer, now)


def line(paced: bool = True, delay: float = 0.002, echo: Echo | None = None, answer: bytes = b"pong") -> Line:
    parrot = Parrot(1, delay=Delay(delay))
    parrot.attentive = True
    parrot.answer = answer
    return Line(SETTINGS, [parrot], paced=paced, echo=echo)


async def opened(emulated: Line) -> tuple[MemoryTransport, Recorder]:
    recorder = Recorder()
    return await MemoryPort(emulated).open(lambda: recorder), recorder


def test_it_is_paced_and_echoes_as_its_line_does() -> None:
    port = MemoryPort(line())
    assert port.settings == SETTINGS
    assert port.paced is True
    assert port.echo is False
    assert MemoryPort(line(paced=False, echo=Echo())).paced is False
    assert MemoryPort(line(paced=False, echo=Echo())).echo is True


def test_in_virtual_time_a_reply_comes_exactly_when_its_last_byte_has_left() -> None:
    async def ask() -> None:
        transport, recorder = await opened(line())
        assert recorder.connections == 1
        assert is_paced(MemoryPort(line()), transport)
        for n in range(1, 4):
            asked = asyncio.get_running_loop().time()
            transport.write(b"ping\x05")
            await recorder.heard(b"pong" * n)
            assert asyncio.get_running_loop().time() - asked == pytest.approx(5 * TAU + 0.002 + 4 * TAU)
        transport.close()
        await recorder.lost()
        assert recorder.losses == [None]

    run_in_virtual_time(ask())


def test_in_real_time_no_reply_comes_before_the_sender_has_read_its_clock_and_its_request_has_left() -> None:
    class Timed(Recorder):
        first = 0.0

        def data_received(self, data: bytes) -> None:
            self.first = self.first or time.monotonic()
            super().data_received(data)

    async def ask() -> None:
        recorder = Timed()
        transport = await MemoryPort(line()).open(lambda: recorder)
        transport.write(b"ping\x05")
        time.sleep(0.03)  # noqa: ASYNC251  as if the process stood still for longer than the exchange takes
        written = time.monotonic()
        await recorder.heard(b"pong")
        assert recorder.first - written > 5 * TAU
        transport.close()
        await recorder.lost()

    asyncio.run(ask())


def test_a_long_reply_comes_in_pieces_with_no_gap_that_would_end_it() -> None:
    class Gaps(Recorder):
        longest = 0.0
        before = 0.0

        def data_received(self, data: bytes) -> None:
            now = asyncio.get_running_loop().time()
            if self.received:
                self.longest = max(self.longest, now - self.before)
            self.before = now
            super().data_received(data)

    async def ask() -> None:
        recorder = Gaps()
        transport = await MemoryPort(line(answer=bytes(200))).open(lambda: recorder)
        transport.write(b"\x05")
        await asyncio.sleep(TAU + 0.002 + 1.01 * TAU)
        assert len(recorder.received) == 1
        await recorder.until(lambda r: len(r.received) == 200)
        assert asyncio.get_running_loop().time() == pytest.approx(TAU + 0.002 + 200 * TAU)
        assert recorder.longest < 0.01
        transport.close()
        await recorder.lost()

    run_in_virtual_time(ask())


def test_an_unpaced_line_that_answers_at_once_never_calls_back_from_within_a_write() -> None:
    async def ask() -> None:
        transport, recorder = await opened(line(paced=False, delay=0.0))
        transport.write(b"\x05")
        assert recorder.received == b""
        await recorder.heard(b"pong")
        assert asyncio.get_running_loop().time() == pytest.approx(0.0, abs=1e-6)
        transport.abort()
        await recorder.lost()

    run_in_virtual_time(ask())


def test_a_transport_that_is_closed_as_bytes_come_hands_over_no_more() -> None:
    async def ask() -> None:
        transport, recorder = await opened(line())
        heard = recorder.data_received

        def close(data: bytes) -> None:
            heard(data)
            transport.close()

        recorder.data_received = close  # type: ignore[method-assign]
        transport.write(b"\x05")
        await recorder.lost()
        await asyncio.sleep(1.0)
        assert len(recorder.received) == 1

    run_in_virtual_time(ask())


def test_it_can_be_unplugged_once_and_then_says_nothing_more() -> None:
    async def ask() -> None:
        emulated = line()
        transport, recorder = await opened(emulated)
        transport.write(b"\x05")
        cause = OSError("unplugged")
        transport.lose(cause)
        transport.close()
        assert transport.is_closing()
        transport.write(b"\x05")
        await asyncio.sleep(1.0)
        assert recorder.losses == [cause]
        assert recorder.received == b""
        transport, recorder = await opened(emulated)
        transport.write(b"\x05")
        await recorder.heard(b"pong")
        assert recorder.received == b"pong"
        transport.close()
        await recorder.lost()

    run_in_virtual_time(ask())


def test_the_rest_of_a_reply_is_not_delivered_after_the_loss() -> None:
    async def ask() -> None:
        transport, recorder = await opened(line())
        transport.write(b"\x05")
        await recorder.heard(b"p")
        transport.lose(None)
        await asyncio.sleep(1.0)
        assert recorder.received == b"p"
        assert recorder.losses == [None]

    run_in_virtual_time(ask())


@pytest.mark.asyncio
async def test_it_works_in_real_time() -> None:
    transport, recorder = await opened(line())
    transport.write(b"\x05")
    await recorder.heard(b"pong")
    transport.close()
    await recorder.lost()


def test_a_port_in_memory_is_the_end_of_its_line() -> None:
    async def look() -> None:
        emulated = Line(SETTINGS, [], latency=0.016)
        port = MemoryPort(emulated)
        assert (port.name, port.receive_latency) == ("the emulated line", 0.016)
        transport, _ = await opened(emulated)
        assert transport.get_extra_info("line") is emulated
        assert transport.get_extra_info("serial", "none") == "none"

    run_in_virtual_time(look())


def test_a_new_connection_gets_no_byte_from_before_it() -> None:
    async def ask() -> None:
        emulated = line()
        emulated.send(b"\x05", 0.0)
        await asyncio.sleep(1.0)
        transport, recorder = await opened(emulated)
        transport.write(b"\x05")
        await recorder.heard(b"pong")
        await asyncio.sleep(1.0)
        assert recorder.received == b"pong"
        transport.close()

    run_in_virtual_time(ask())


def test_a_new_connection_gets_the_bytes_that_are_still_on_the_line() -> None:
    async def ask() -> None:
        emulated = line()
        emulated.prompt = False
        emulated.send(b"\x05", 0.0)
        _, recorder = await opened(emulated)
        await recorder.heard(b"p")  # byte by byte, as from a real port
        assert recorder.received == b"p"
        await recorder.heard(b"pong")

    run_in_virtual_time(ask())


def test_a_quick_reply_does_not_wait_for_a_late_one() -> None:
    async def ask() -> None:
        emulated = line(delay=1.0, answer=b"late")
        transport, recorder = await opened(emulated)
        transport.write(b"\x05")
        await asyncio.sleep(0.1)
        emulated.devices[0].attentive = False
        quick = Parrot(2, delay=Delay(0.002))
        quick.attentive = True
        emulated.add(quick)
        transport.write(b"\x05")
        await recorder.heard(b"pong")
        assert asyncio.get_running_loop().time() == pytest.approx(0.1 + TAU + 0.002 + 4 * TAU)
        await recorder.until(lambda r: len(r.received) > 4)
        assert asyncio.get_running_loop().time() == pytest.approx(TAU + 1.0 + TAU)

    run_in_virtual_time(ask())


def test_held_writes_leave_together_when_they_are_released() -> None:
    async def ask() -> None:
        transport, recorder = await opened(line())
        transport.release()
        assert recorder.flow == []
        transport.hold()
        assert transport.get_write_buffer_size() == 0
        transport.write(b"ping")
        transport.hold()
        transport.write(b"\x05")
        await asyncio.sleep(1.0)
        assert recorder.received == b""
        assert transport.get_write_buffer_size() == 5
        assert set(recorder.flow) == {"pause"}
        transport.release()
        await recorder.heard(b"pong")
        assert recorder.flow[-1] == "resume"
        assert recorder.flow.count("resume") == 1
        assert transport.get_write_buffer_size() == 0
        transport.write(b"\x05")
        await recorder.heard(b"pongpong")
        assert recorder.flow[-1] == "resume"

    run_in_virtual_time(ask())


def test_writes_held_when_the_port_is_lost_never_leave() -> None:
    async def ask() -> None:
        emulated = line()
        transport, recorder = await opened(emulated)
        transport.hold()
        transport.write(b"\x05")
        transport.abort()
        transport.release()
        await asyncio.sleep(1.0)
        assert (recorder.flow, recorder.received, recorder.losses) == (["pause"], b"", [None])
        assert emulated.next_event() == float("inf")

    run_in_virtual_time(ask())


def test_a_port_set_to_another_rate_gets_no_reply_until_it_has_the_rate_of_the_line() -> None:
    async def ask() -> None:
        transport, recorder = await opened(line())
        await transport.tune(LineSettings(19200))
        transport.write(b"\x05")
        await asyncio.sleep(1.0)
        assert recorder.received == b""
        await transport.tune(SETTINGS)
        transport.write(b"\x05")
        await recorder.heard(b"pong")

    run_in_virtual_time(ask())
