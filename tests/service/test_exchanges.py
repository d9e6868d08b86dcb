"""What passes on a line, told to programs that look at its wire: by a real socket, on an emulated line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from busmaster import Hcp2Controller, RemoteBus
from busmaster.arbiter.tap import Attempt, Verdict
from busmaster.errors import NoReply
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.service.exchanges import MOST_BYTES, MOST_KEPT, Listener, said_passage
from tests.service.lines import ABSENT, PATIENT, Served, on_a_served_line, until
from tests.service.schema import check


def attempt() -> Attempt:
    return Attempt("hcp2", 5, hcp2.Read(1), PATIENT)


def tapped(line: Served) -> bool:
    return line.bus.pump.tap is not None


class Heard:
    """The exchanges that were told."""

    def __init__(self) -> None:
        self.exchanges: list[Mapping[str, Any]] = []

    def __call__(self, body: Mapping[str, Any]) -> None:
        self.exchanges += body["exchanges"]

    def of(self, purpose: str = "") -> list[Mapping[str, Any]]:
        return [one for one in self.exchanges if one.get("purpose") == purpose and one.get("request")]


def test_each_exchange_is_told_with_what_was_said_and_what_came_of_it(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        heard = Heard()
        await remote.exchanges(heard)
        await until(lambda: tapped(line))
        controller = Hcp2Controller(remote, 5)
        await controller.write(1, 2.5)
        await controller.read(1)
        await until(lambda: len(heard.of()) == 2)
        write, read = heard.of()
        assert (write["command"], write["writes"], write["verdict"]) == ("write element 1 = 2.5", True, "ok")
        assert (read["address"], read["result"], read["attempt"]) == (5, "2.5", 1)
        assert read["begun"] <= read["said"][0][0] <= read["said"][-1][0] <= read["ended"]
        assert read["said"][0][1] == "master"
        assert any(who == "node" for _, who, _ in read["said"])
        assert bytes.fromhex(read["said"][0][2]) == hcp2.Read(1).open(5, PATIENT).request

    on_a_served_line(tmp_path, story)


def test_attempts_at_a_node_that_does_not_answer_are_told_and_the_line_settles_between_them(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        heard = Heard()
        await remote.exchanges(heard)
        await until(lambda: tapped(line))
        absent = Hcp2Controller(remote, ABSENT)
        with pytest.raises(NoReply) as caught:
            await absent.read(1)
        await until(lambda: len(heard.of()) == caught.value.attempts)
        first, second, *_ = told = heard.of()
        assert [(one["attempt"], one["verdict"]) for one in told] == [(n + 1, "no reply") for n in range(len(told))]
        assert {one["request"] for one in told} == {first["request"]}
        assert 0 < second["settled"] - first["settled"] <= second["begun"] - first["ended"] + 0.01

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


def test_what_nobody_asked_for_and_what_is_long_is_told_within_bounds() -> None:
    listener, one = Listener(), attempt()
    listener.received(0.0, b"of an exchange that nobody listened to", None)
    listener.transmitted(0.0, b"ask", one)
    one.end(Verdict.OK, None, 0.0)
    for number in range(3):
        listener.received(float(number), b"x" * MOST_BYTES, None)
    _, passage = listener.take()
    told = json.loads(json.dumps(said_passage(passage)))
    check("unasked", told)
    assert (told["begun"], told["ended"], told["bytes"]) == (0.0, 0.0, 3 * MOST_BYTES)
    assert len(bytes.fromhex(told["said"][0][2])) == MOST_BYTES
    assert listener.take() == []


def test_of_too_many_exchanges_the_oldest_are_left_out_and_counted() -> None:
    listener = Listener()
    for number in range(MOST_KEPT + 3):
        listener.transmitted(float(number), b"x", attempt())
    assert listener.lost == 3


def test_what_closes_an_exchange_belongs_to_it() -> None:
    listener, one = Listener(), attempt()
    listener.transmitted(1.0, b"ask", one)
    listener.received(1.1, b"answer", one)
    listener.transmitted(1.2, b"ack", None)
    listener.received(1.3, b"!", None)
    assert [len(passage.said) for passage in listener._passages] == [3, 1]
