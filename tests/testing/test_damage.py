"""The damage that the conformance kit does to a reply, and the devices that it converses with."""

from __future__ import annotations

from math import comb
from random import Random

import pytest

from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing.cases import Case, RoundTrip, answers_of
from busmaster.testing.damage import FEW_BYTES, MANY_BYTES, bytewise, flips, garbage_chunks, splits


@pytest.mark.parametrize(
    ("length", "number"),
    [
        (1, 0),
        (2, 1),
        (FEW_BYTES, 2 ** (FEW_BYTES - 1) - 1),
        (FEW_BYTES + 1, FEW_BYTES + comb(FEW_BYTES, 2) + 1),
        (MANY_BYTES, MANY_BYTES - 1 + comb(MANY_BYTES - 1, 2) + 1),
        (MANY_BYTES + 1, MANY_BYTES + 1),
    ],
)
def test_a_reply_is_split_in_every_way_if_it_is_short_and_always_into_bytes(length: int, number: int) -> None:
    data = bytes(range(length))
    found = list(splits(data))
    assert len(found) == len({tuple(chunks) for chunks in found}) == number
    assert all(b"".join(chunks) == data and all(chunks) for chunks in found)
    assert length == 1 or bytewise(data) in found


@pytest.mark.parametrize("bits", [7, 8])
def test_each_bit_of_each_byte_is_flipped_once(bits: int) -> None:
    data = b"\x00\x55\xff"
    found = list(flips(data, bits))
    assert len(set(found)) == len(found) == 3 * bits
    for flipped in found:
        [changed] = [one ^ other for one, other in zip(data, flipped, strict=True) if one != other]
        assert changed.bit_count() == 1
        assert changed < 1 << bits


def test_garbage_is_noise_or_a_damaged_reply_and_the_same_with_the_same_seed() -> None:
    reply, like_the_reply = bytes(range(100, 130)), 0
    for seed in range(300):
        chunks = list(garbage_chunks(Random(seed), reply))
        assert chunks == list(garbage_chunks(Random(seed), reply))
        like_the_reply += reply[:5] in b"".join(chunks) or reply[-5:] in b"".join(chunks)
    assert 150 < like_the_reply < 300


def test_a_device_answers_each_request_once() -> None:
    answer = answers_of(make_device("hcp2", 5))
    asked = hcp2.Read(1).open(5, hcp2.PROFILE.timings).request
    replies = [answer(asked), answer(b""), answer(asked)]
    assert replies[0] == replies[2] != b""
    assert replies[1] == b""


def test_a_case_is_named_by_command_and_address_and_a_value_is_read_back_as_it_was_written() -> None:
    assert str(Case(hcp2.Read(1), 5, [])) == "read element 1 of 5"
    trip = RoundTrip(5, lambda value: hcp2.Write(1, (value,)), hcp2.Read(1), [2.0])
    assert trip.read_back(2.0) == 2.0
