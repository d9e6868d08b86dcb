"""What a value means: names, and what may be said of it."""

from __future__ import annotations

import json
from dataclasses import replace
from math import inf, nan
from typing import Any

import pytest

from busmaster import GarbledReply, Meaning
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import MeansNothing, Named, bit_of
from busmaster.errors import InvalidCommand
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex import StatusWord
from tests.stories import cycles, on_a_bus

WORD = Meaning(bits={"READY": 0, "FAULT": 3})


def test_a_number_with_a_name_counts_and_is_stored_as_the_number() -> None:
    named = Named(9, "READY|FAULT")
    assert (named, named + 1, json.dumps(named), f"{named:d}") == (9, 10, "9", "9")
    assert str(named) == "9 READY|FAULT"
    assert str(Named(0, "")) == "0"


@pytest.mark.parametrize(
    ("meaning", "value", "text"),
    [
        (WORD, 9.0, "9 READY|FAULT"),
        (WORD, 16, "16"),
        (WORD, -1, "-1 READY|FAULT"),
        (Meaning(bits={"ON": 7}), StatusWord.ENABLED, str(StatusWord.ENABLED)),
        (Meaning(labels={128: "enabled"}), StatusWord.ENABLED, "128 enabled"),
        (WORD, frozenset({3}), "frozenset({3})"),
        (Meaning(labels={0: "off", 1: "on"}), 1.0, "1 on"),
        (Meaning(labels={0: "off", 1: "on"}), True, "1 on"),
        (Meaning(labels={0: "off", 1: "on"}), 7.0, "7.0"),
        (Meaning(labels={0: "off", 1: "on"}), 0.5, "0.5"),
        (Meaning(labels={-1: "back"}), -1, "-1 back"),
    ],
)
def test_a_value_gets_its_name_and_one_without_a_name_stays_as_it_is(meaning: Meaning, value: Any, text: str) -> None:
    assert str(meaning.named(value)) == text


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_what_is_no_whole_number_has_no_name(value: float) -> None:
    assert WORD.named(value) is value


@pytest.mark.parametrize(
    ("value", "bit", "is_set"),
    [(8.0, 3, True), (8, 0, False), (-32768, 15, True), (frozenset({200}), 200, True), (StatusWord.ENABLED, 7, True)],
)
def test_a_bit_is_read_off_words_and_flags(value: Any, bit: int, is_set: bool) -> None:
    assert bit_of(value, bit) is is_set


@pytest.mark.parametrize("value", [0.5, nan, inf, "text", (1, 2), None])
def test_what_is_no_word_has_no_bits(value: Any) -> None:
    with pytest.raises(ValueError, match="not a word"):
        bit_of(value, 0)


@pytest.mark.parametrize(
    ("said", "field"),
    [
        ({"precision": -1}, "precision"),
        ({"precision": 16}, "precision"),
        ({"bits": {"READY": 0, "ON": 0}}, "bits"),
        ({"bits": {"READY": -1}}, "bits"),
        ({"bits": {"1": 0}}, "bits"),
        ({"bits": {"a/b": 0}}, "bits"),
        ({"bits": {"READY": 0}, "labels": {0: "off"}}, "labels"),
        ({"bits": {"READY": 0}, "precision": 1}, "precision"),
        ({"bits": {"READY": 0}, "deadband": 1}, "deadband"),
        ({"labels": {0: "off"}, "high": 1}, "high"),
        ({"labels": {0: "off"}, "deadband": 1}, "deadband"),
        ({"labels": {True: "on"}}, "labels"),
        ({"bits": {"READY": True}}, "bits"),
        ({"labels": {0: "two\nlines"}}, "labels"),
        ({"labels": {0: ""}}, "labels"),
        ({"labels": {0.5: "half"}}, "labels"),
        ({"deadband": -0.1}, "deadband"),
        ({"deadband": nan}, "deadband"),
        ({"heartbeat": 0}, "heartbeat"),
        ({"heartbeat": inf}, "heartbeat"),
        ({"low": 2, "high": 1}, "low"),
        ({"low": 1, "high": 1}, "low"),
        ({"low": -inf}, "low"),
        ({"high": True}, "high"),
        ({"high": 1, "hysteresis": -1}, "hysteresis"),
        ({"hysteresis": 1}, "hysteresis"),
        ({"low": 0, "high": 1, "hysteresis": 1}, "hysteresis"),
    ],
)
def test_what_means_nothing_is_refused_and_names_its_field(said: dict[str, Any], field: str) -> None:
    with pytest.raises(MeansNothing, match=f"^{field}: ") as refused:
        Meaning(**said)
    assert refused.value.field == field


def test_hysteresis_that_is_left_out_is_a_hundredth_of_what_lies_between() -> None:
    assert Meaning(low=10, high=20).margin == pytest.approx(0.1)
    assert Meaning(high=-50).margin == pytest.approx(0.5)
    assert Meaning(low=0).margin == 0
    assert Meaning(low=0, high=20, hysteresis=0).margin == 0


def test_bits_are_points_of_their_own_that_cost_no_exchange() -> None:
    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        await drive.write(11, 9)
        word = replace(drive.point("11"), unit="rpm", meaning=WORD)
        ready, fault = word.bits
        assert (ready.item, fault.key) == ("11.READY", "1/11.FAULT")
        assert (ready.unit, fault.unit) == ("", "")
        group = bus.poll_group("axes", period=0.1, points=[word, *word.bits])
        [snapshot] = await cycles(group, 1)
        assert len(group.poll.results) == 1
        assert [snapshot[point].value for point in (word, ready, fault)] == [9, True, True]
        assert str(snapshot[word].value) == "9 READY|FAULT"
        await word.write(8)
        assert (await ready.read(), await fault.read()) == (False, True)
        assert await word.bit("FAULT").read(max_age=inf) is True

    on_a_bus(story)


def test_a_bit_is_never_written_alone() -> None:
    async def story(bus: Bus) -> None:
        word = replace(Hcp2Controller(bus, 1).point("11"), meaning=WORD)
        assert word.writable
        assert not word.bit("READY").writable
        with pytest.raises(InvalidCommand, match=r"11\.READY is read-only"):
            await word.bit("READY").write(True)
        with pytest.raises(InvalidCommand, match="no bit 'REDY'; did you mean 'READY'"):
            word.bit("REDY")

    on_a_bus(story)


def test_a_number_that_is_no_word_is_an_error_of_its_bits_alone() -> None:
    async def story(bus: Bus) -> None:
        drive = Hcp2Controller(bus, 1)
        await drive.write(11, 0.5)
        word = replace(drive.point("11"), meaning=WORD)
        [snapshot] = await cycles(bus.poll_group("axes", period=0.1, points=[word, *word.bits]), 1)
        assert snapshot[word].value == 0.5
        assert isinstance(snapshot[word.bit("READY")].error, GarbledReply)

    on_a_bus(story)


def test_a_label_stands_for_its_number_if_only_one_has_it() -> None:
    modes = Meaning(labels={0: "off", 1: "run", 2: "run"})
    assert modes.number_of("off") == 0
    with pytest.raises(InvalidCommand, match="'run' is the label of more than one value: use 'off', 'run', 'run'"):
        modes.number_of("run")
    with pytest.raises(InvalidCommand, match="'fast' is the label of no value: use 'off'"):
        modes.number_of("fast")


@pytest.mark.parametrize(("said", "by_exception"), [({}, False), ({"deadband": 0}, True), ({"heartbeat": 1.0}, True)])
def test_values_are_reported_by_exception_if_a_deadband_or_a_heartbeat_is_set(
    said: dict[str, Any], by_exception: bool
) -> None:
    assert Meaning(**said).by_exception is by_exception
    word = Meaning(bits={"READY": 0}, **said)
    assert (word.of_bit("READY").deadband, word.of_bit("READY").heartbeat) == (word.deadband, word.heartbeat)


@pytest.mark.parametrize("field", ["precision", "low", "high", "hysteresis"])
@pytest.mark.parametrize(("names", "called"), [({"bits": {"READY": 0}}, "bits"), ({"labels": {0: "off"}}, "labels")])
def test_what_is_for_quantities_is_refused_for_a_number_with_names(names: Any, called: str, field: str) -> None:
    with pytest.raises(MeansNothing, match=f"^{field}: is for quantities, and this number has {called}"):
        Meaning(**{**names, field: 1})
