"""Transfers of many values as exchanges: blocks of 32, the rest one by one, each at its own address."""

from __future__ import annotations

from dataclasses import replace

import pytest

from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.blocks import Count, Part, place, reads, reads_back, writes
from busmaster.protocols.msc.codec import BLOCK, PROFILE, BlockRead, BlockWrite, DataRead, DataWrite, Merging


def test_a_place_lies_its_steps_behind_the_first() -> None:
    assert [place(100, index, 2) for index in (0, 1, 32)] == [100, 102, 164]
    assert place(100, 0, None) == 100
    assert place(65535, 0, 1) == 65535
    assert place(65533, 1, 2) == 65535
    with pytest.raises(InvalidCommand):
        place(65534, 1, 2)
    with pytest.raises(InvalidCommand, match="while the address step is unknown, 32 values at most"):
        place(100, 1, None)


def test_values_are_read_in_blocks_and_a_lone_one_by_itself() -> None:
    assert reads(100, 1, None) == [Part(DataRead(100), 100, 1)]
    assert reads(100, 2, None) == [Part(BlockRead(100), 100, 2)]
    assert reads(100, BLOCK, None) == [Part(BlockRead(100), 100, 32)]
    assert reads(100, 65, 2) == [
        Part(BlockRead(100), 100, 32),
        Part(BlockRead(164), 164, 32),
        Part(DataRead(228), 228, 1),
    ]
    with pytest.raises(InvalidCommand, match="address step"):
        reads(100, BLOCK + 1, None)


def test_a_transfer_stays_within_the_addresses() -> None:
    assert sum(part.size for part in reads(0, 65535, 1)) == 65535
    assert reads(65534, 2, 1)[0].size == 2
    for address, count, step in ((65534, 3, 1), (65535, 2, 1)):
        with pytest.raises(InvalidCommand):
            reads(address, count, step)
    for count in (-1, 0, 65536):
        with pytest.raises(InvalidCommand, match=f"there are not {count} values to read"):
            reads(0, count, 1)


def test_what_was_written_is_read_back_in_blocks_that_begin_one_value_later() -> None:
    assert reads_back(100, 1, 2) == reads(100, 1, 2)
    assert reads_back(100, 5, None) == reads(100, 5, None)
    assert reads_back(100, 34, 2) == [
        Part(DataRead(100), 100, 1),
        Part(BlockRead(102), 102, 32),
        Part(DataRead(166), 166, 1),
    ]
    assert reads_back(100, 2, 2) == [Part(DataRead(100), 100, 1), Part(DataRead(102), 102, 1)]


def test_whole_blocks_are_written_at_once_and_the_rest_one_by_one() -> None:
    values = list(range(66))
    assert writes(100, values, 2) == [
        (BlockWrite(100, tuple(range(32))), 32),
        (BlockWrite(164, tuple(range(32, 64))), 32),
        (DataWrite(228, 64), 1),
        (DataWrite(230, 65), 1),
    ]
    assert writes(100, [7], None) == [(DataWrite(100, 7), 1)]
    assert writes(100, values[:32], None) == [(BlockWrite(100, tuple(range(32))), 32)]
    with pytest.raises(InvalidCommand, match="no value to write"):
        writes(100, [], 2)
    with pytest.raises(InvalidCommand, match="address step"):
        writes(100, [1, 2], None)


def test_progress_is_told_of_the_sum_so_far() -> None:
    told: list[tuple[int, int]] = []
    count = Count(lambda done, total: told.append((done, total)), 40)
    for values in (32, 1, 7):
        count.add(values)
    assert told == [(32, 40), (33, 40), (40, 40)]
    Count(None, 40).add(32)


def test_the_values_of_a_block_have_the_addresses_of_the_step_and_without_one_only_the_first_is_known() -> None:
    values = tuple(range(100, 100 + BLOCK))
    stepped = replace(PROFILE, merge=Merging(address_step=4))
    assert BlockRead(2000).place_values(values, stepped) == {
        ("data", 2000 + 4 * number): value for number, value in enumerate(values)
    }
    assert BlockRead(2000).place_values(values, PROFILE) == {("data", 2000): 100}
