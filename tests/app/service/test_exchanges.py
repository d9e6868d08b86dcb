"""What passes on a line, told to programs that look at its wire: by a real socket, on an emulated line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, RemoteBus
from busmaster.app.service.exchanges import (
    LONGEST_RESULT,
    MOST_BYTES,
    MOST_KEPT,
    RECEIVED_AT_ONCE,
    ExchangesBroadcast,
    Listener,
    encode_exchange,
)
from busmaster.app.service.messages import encode
from busmaster.contract.tap import Attempt, Verdict
from busmaster.emulator.line import Line
from busmaster.errors import NoReply
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.app.service.lines import ABSENT, PATIENT, Served, on_a_served_line, until
from tests.app.service.schema import check
from tests.stories import in_use


def attempt() -> Attempt:
    return Attempt("hcp2", 5, hcp2.Read(1), PATIENT)


def tapped(line: Served) -> bool:
    return line.bus._pump.tap is not None


class Told(NamedTuple):
    """An exchange as it is told; times are in microseconds."""

    said: list[tuple[int, str, str]]
    bytes: int
    ended: int
    protocol: str
    address: int
    command: str
    writes: bool
    purpose: str
    request: int
    attempt: int
    verdict: str
    result: str
    late: bool
    quiet_time: int

    @property
    def begun(self) -> int:
        return self.said[0][0]


class Heard:
    """The exchanges that were told and that a caller has asked for."""

    def __init__(self) -> None:
        self.exchanges: list[Told] = []

    def __call__(self, body: Mapping[str, Any]) -> None:
        told = [Told(*one) for one in body["exchanges"] if len(one) == len(Told._fields)]
        self.exchanges += [one for one in told if not one.purpose]


def test_each_exchange_is_told_with_what_was_said_and_what_came_of_it(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        heard = Heard()
        await remote.exchanges(heard)
        await until(lambda: tapped(line))
        in_use(line.bus)
        before = line.bus.now()
        controller = Hcp2Controller(remote, 5)
        await controller.write(1, 2.5)
        await controller.read(1)
        after = line.bus.now()
        await until(lambda: len(heard.exchanges) == 2)
        write, read = heard.exchanges
        assert (write.protocol, write.command, write.writes, write.verdict) == (
            "hcp2",
            "write element 1 = 2.5",
            True,
            "ok",
        )
        assert (read.address, read.result, read.request, read.attempt, read.late) == (5, "2.5", 2, 1, False)
        assert write.ended <= read.begun <= read.said[-1][0] <= read.ended
        assert before <= write.begun / 1e6 <= read.ended / 1e6 <= after
        assert read.said[0][1] == "master"
        assert any(who == "node" for _, who, _ in read.said)
        assert bytes.fromhex(read.said[0][2]) == hcp2.Read(1).open(5, PATIENT).request
        assert read.bytes == sum(len(bytes.fromhex(data)) for _, _, data in read.said)

    on_a_served_line(tmp_path, story)


def test_attempts_at_a_node_that_does_not_answer_are_told_and_the_line_resynchronises_between_them(
    tmp_path: Path,
) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        heard = Heard()
        await remote.exchanges(heard)
        await until(lambda: tapped(line))
        absent = Hcp2Controller(remote, ABSENT)
        with pytest.raises(NoReply) as caught:
            await absent.read(1)
        await until(lambda: len(heard.exchanges) == caught.value.attempts)
        first, second, *_ = told = heard.exchanges
        assert [(one.attempt, one.verdict) for one in told] == [(n + 1, "no reply") for n in range(len(told))]
        assert {one.request for one in told} == {first.request}
        assert 0 < second.quiet_time - first.quiet_time <= second.begun - first.ended + 10_000

    on_a_served_line(tmp_path, story)


def test_a_line_is_tapped_only_while_somebody_looks(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        for _ in range(3):
            assert not tapped(line)
            stream = await remote.exchanges(Heard())
            other = await remote.exchanges(Heard())
            await until(lambda: tapped(line))
            stream.close()
            await Hcp2Controller(remote, 5).read(1)
            assert tapped(line)
            other.close()
            await until(lambda: not tapped(line))

    on_a_served_line(tmp_path, story)


def test_exchanges_are_sent_five_times_a_second() -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)]))) as bus:
            bodies = ExchangesBroadcast(bus, lambda: None)._bodies()
            begun = bus.now()
            for _ in range(6):
                await anext(bodies)
            assert bus.now() - begun == pytest.approx(1.0, abs=0.01)
            await bodies.aclose()

    run_in_virtual_time(run())


def test_what_nobody_asked_for_and_what_is_long_is_told_within_bounds() -> None:
    listener, one = Listener(), attempt()
    listener.received(0.0, b"of an exchange that nobody listened to", None)
    listener.transmitted(0.0, b"ask", one)
    one.end(Verdict.OK, None, 0.0)
    for number in range(3):
        listener.received(1.5 + number, b"x" * MOST_BYTES, None)
    [_, passage], _ = listener.take()
    told = json.loads(encode(encode_exchange(passage)))
    check("UnexpectedBytes", told)
    assert told == [[[1_500_000, "node", b"x".hex() * MOST_BYTES]], 3 * MOST_BYTES]
    assert listener.take() == ([], 0)


def test_of_a_flood_no_more_is_kept_than_is_told() -> None:
    listener = Listener()
    listener.transmitted(0.0, b"ask", attempt())
    for number in range(10 * RECEIVED_AT_ONCE):
        listener.received(float(number), b"x" * 1000, None)
        assert len(listener._received) < RECEIVED_AT_ONCE
    assert sum(len(passage.transmissions) for passage in listener._exchanges) <= 2


def test_of_too_many_exchanges_the_oldest_are_left_out_and_counted() -> None:
    listener = Listener()
    for number in range(MOST_KEPT + 3):
        listener.transmitted(float(number), b"x", attempt())
    assert listener.take() == ([], 3)


def test_what_closes_an_exchange_belongs_to_it() -> None:
    listener, one = Listener(), attempt()
    listener.transmitted(1.0, b"ask", one)
    listener.received(1.1, b"answer", one)
    listener.transmitted(1.2, b"ack", None)
    listener.received(1.3, b"!", None)
    one.end(Verdict.OK, None, 1.2)
    passages, _ = listener.take()
    assert [len(passage.transmissions) for passage in passages] == [3, 1]


def test_each_field_of_an_attempt_is_reported_and_a_long_result_is_cut() -> None:
    one = Attempt("hcp2", 5, hcp2.Write(1, (2.5,)), PATIENT)
    one.purpose, one.transaction, one.number, one.late, one.quiet_time = "axes", 7, 3, True, 0.25
    listener = Listener()
    listener.transmitted(1.5, b"ask", one)
    listener.received(1.75, b"x" * (MOST_BYTES + 50), one)
    assert listener.take() == ([], 0)  # it has not ended
    one.end(Verdict.OK, "r" * (LONGEST_RESULT + 1), 2.5)
    [[exchange], _] = listener.take()
    reported = json.loads(encode(encode_exchange(exchange)))
    check("ExchangeForm", reported)
    found = Told(*reported)
    assert reported[0] == [[1_500_000, "master", b"ask".hex()], [1_750_000, "node", b"x".hex() * (MOST_BYTES - 3)]]
    assert (found.bytes, found.ended, found.quiet_time) == (3 + MOST_BYTES + 50, 2_500_000, 250_000)
    assert (found.protocol, found.address, found.command, found.writes) == ("hcp2", 5, "write element 1 = 2.5", True)
    assert (found.purpose, found.request, found.attempt, found.verdict, found.late) == ("axes", 7, 3, "ok", True)
    assert found.result == f"{'r' * LONGEST_RESULT}..."


@pytest.mark.parametrize(
    ("result", "text"),
    [(None, ""), (0.0, "0"), ("r" * LONGEST_RESULT, "r" * LONGEST_RESULT)],
    ids=["none", "0", "long"],
)
def test_the_result_of_an_attempt_is_text(result: object, text: str) -> None:
    listener, one = Listener(), attempt()
    listener.transmitted(1.0, b"ask", one)
    one.end(Verdict.OK, result, 1.2)
    [[exchange], _] = listener.take()
    assert Told(*json.loads(encode(encode_exchange(exchange)))).result == text


def test_an_exchange_that_is_left_out_by_none_is_kept_and_later_bytes_begin_another() -> None:
    listener = Listener()
    attempts = [attempt() for _ in range(MOST_KEPT)]
    for number, one in enumerate(attempts):
        listener.transmitted(float(number), b"x", one)
        one.end(Verdict.OK, None, float(number))
    exchanges, left_out = listener.take()
    assert (len(exchanges), left_out) == (MOST_KEPT, 0)
    listener.received(1000.0, b"late", None)
    listener.transmitted(1001.0, b"ack", None)
    [late], _ = listener.take()
    assert [one.sender for one in late.transmissions] == ["node", "master"]


def test_unexpected_bytes_are_reported_each_time_and_those_of_the_master_between_two_reports_are_not() -> None:
    listener, one = Listener(), attempt()
    listener.transmitted(1.0, b"ask", one)
    one.end(Verdict.OK, None, 1.2)
    listener.take()
    for when, noise in ((2.0, b"first"), (3.0, b"second"), (4.0, b"third")):
        listener.received(when, noise, None)
        [exchange], _ = listener.take()
        assert [found.data for found in exchange.transmissions] == [noise.hex()]
        listener.transmitted(when + 0.5, b"ack", None)  # what it closes was reported already
        assert listener.take() == ([], 0)


def test_what_the_master_sends_is_put_in_order_a_few_at_a_time() -> None:
    listener, one = Listener(), attempt()
    for number in range(2 * RECEIVED_AT_ONCE):
        listener.transmitted(float(number), b"x", one)
        assert len(listener._received) < RECEIVED_AT_ONCE
    assert [exchange.bytes for exchange in listener._exchanges] == [2 * RECEIVED_AT_ONCE]
    listener = Listener()
    listener.transmitted(0.0, b"the end of an earlier exchange", None)
    listener.received(0.1, b"?", None)
    listener.transmitted(0.2, b"ask", one)
    one.end(Verdict.OK, None, 1.2)
    [exchange], _ = listener.take()
    assert exchange.attempt is one
