"""A plain read is known by its words: what is taken for one is one, and it is carried out as any other request."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from busmaster import RemoteBus
from busmaster.app.service.connection import Connection
from busmaster.app.service.messages import Malformed, numbered
from busmaster.app.service.reads import SHORT, PlainRead, plain_read_of, words_of
from busmaster.bounds import MOST_REQUESTS
from busmaster.protocols.hcp2 import PROTOCOL
from busmaster.protocols.hcp2.codec import PROFILE, Read
from tests.app.service.lines import Served, on_a_line, on_a_served_line, raw

READ = Read(1)
WORDS = words_of("hcp2", 5, READ)
PARTS = (
    "",
    '"',
    "{",
    "}",
    "}}",
    ",",
    ',"id":',
    '"id":7',
    '"step":0',
    "0",
    "1",
    "12",
    "-",
    ".5",
    " ",
    "\n",
    "\u0663",
    "true",
)
OTHERS = (
    WORDS,
    f"{WORDS}}}",
    f'{WORDS},"id":"3"}}',
    f'{WORDS},"id":03}}',
    f'{WORDS},"id":3.0}}',
    f'{WORDS},"id":-3}}',
    f'{WORDS},"id":\u0663}}',
    f'{WORDS}, "id":3}}',
    f'{WORDS},"id":3}}}}',
    f'{WORDS},"id":3',
    f'{WORDS},"id":3,"id":4}}',
    numbered(WORDS[1:], 3),
    numbered(WORDS.replace('"2.0"', '"1.0"'), 3),
    numbered(WORDS.replace('"request"', '"check"'), 3),
    numbered(WORDS.replace('"hcp2"', '"profibus"'), 3),
    numbered(WORDS.replace('"element":1', '"element":1000'), 3),
    numbered(WORDS.replace('"params"', '"more":{},"params"'), 3),
    numbered(WORDS.replace('"address":5', '"address":5,"requested":1.5'), 3),
    numbered(WORDS.replace('"read","element":1', '"write","element":1,"values":[7.0]'), 3),
    numbered(f'{WORDS[:-1]},"options":{{"retries":0}}}}', 3),
    numbered(f"{WORDS[:-2]}{' ' * SHORT}}}}}", 3),
)
"""Messages that are no plain read of the usual form, or are none at all."""


def test_a_plain_read_is_known_by_its_words_whatever_its_number() -> None:
    for number in (0, 3, 10**15):
        assert plain_read_of(numbered(WORDS, number)) == (number, PlainRead("hcp2", 5, READ))


@pytest.mark.parametrize("message", OTHERS)
def test_any_other_message_is_read_as_it_always_is(message: str) -> None:
    for _ in range(2):
        assert plain_read_of(message) is None
    assert plain_read_of(numbered(WORDS, 3).encode()) is None


def test_what_is_taken_for_a_plain_read_says_that_and_nothing_else() -> None:
    chance = random.Random(17)
    taken = 0
    for _ in range(10_000):
        message = numbered(WORDS, chance.choice((3, 17)))
        for _ in range(chance.randrange(1, 4)):
            begin = max(0, len(message) - int(chance.expovariate(1 / 20)))
            end = min(len(message), begin + chance.randrange(3))
            message = message[:begin] + chance.choice(PARTS) + message[end:]
        if (found := plain_read_of(message)) is not None:
            taken += 1
            number, read = found
            said = json.loads(message)
            assert (said.pop("jsonrpc"), said.pop("method"), said.pop("id")) == ("2.0", "request", number)
            params = said.pop("params")
            assert (params.pop("protocol"), params.pop("address")) == (read.protocol, read.address)
            assert PROTOCOL.read_back(params.pop("command")) == read.command
            assert not said
            assert not params
    assert taken > 100


def test_a_program_says_a_plain_read_in_the_same_words_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    send = Connection.send

    def noted(self: Connection, text: str) -> None:
        said.append(text)
        send(self, text)

    async def story(line: Served, remote: RemoteBus) -> None:
        node = remote.node(PROFILE, 5)
        await node.request(READ)
        monkeypatch.setattr(Connection, "send", noted)
        assert [await node.request(READ) for _ in range(2)] == [0, 0]
        asked = [text for text in said if '"method"' in text]
        first = json.loads(asked[0])["id"]
        assert asked == [numbered(WORDS, first), numbered(WORDS, first + 1)]
        del said[:]
        await node.request(READ, finish_within=5.0)
        assert "requested" in json.loads(said[0])["params"]  # what it takes to come is a part of its time

    on_a_served_line(tmp_path, story)


def test_a_plain_read_is_refused_where_its_node_was_named_wrongly(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            await client.connection.send(numbered(WORDS, 1))
            assert (await client.hear())["result"] == 0
            assert "error" in await client.ask("node", protocol="hcp2", address=5, retries=7)
            await client.connection.send(numbered(WORDS, 1))
            assert "other retries" in (await client.hear())["error"]["message"]

    on_a_line(tmp_path, story)


def test_of_plain_reads_too_so_many_may_be_unanswered_and_each_has_a_number_of_its_own(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            [owner] = line.service.clients
            read = PlainRead("hcp2", 5, READ)
            for number in range(MOST_REQUESTS):
                owner.requests.begin(number, read)
            with pytest.raises(Malformed, match="request 0 is already in progress"):
                owner.requests.begin(0, read)
            owner.requests.begin(MOST_REQUESTS, read)
            assert len(owner.unfinished) == MOST_REQUESTS
            said = await client.hear()
            assert (said["id"], said["error"]["data"]["error"]) == (MOST_REQUESTS, "BacklogFull")

    on_a_line(tmp_path, story)
