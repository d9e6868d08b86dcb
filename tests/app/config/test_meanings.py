"""What a file says that its points mean: of every protocol, read again, and mistyped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from math import inf
from typing import Any

import pytest

from busmaster.app.config import FileError, LineFile, emulated_line
from busmaster.app.config.point_section import POINT_KEYS, check_suits, sort_of
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.bus.alarms import AlarmChanged
from busmaster.bus.meaning import Meaning, Named
from busmaster.bus.points import Point
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand
from busmaster.registry import find
from tests.stories import in_virtual_time

PLACES = {
    "hcp": ("address = 5", "10"),
    "hcp2": ("address = 5", "10"),
    "msc": ("address = 3", "2008"),
    "mentor": ("address = 14", "1.17"),
    "ct-ansi": ("address = 14", "1.21"),
    "dc104": ("", "12"),
    "modbus": ("address = 17", "holding:40"),
}
GROUP = '\n[groups.axes]\nperiod = 0.02\npoints = "w/a"\n'


def file(kind: str, points: str) -> LineFile:
    """Read a file with one node `w`, whose points begin on line 5."""
    rate = 9600 if kind == "msc" else 19200
    address, _ = PLACES.get(kind, PLACES["hcp2"])
    head = f'port = "/dev/ttyUSB0?baudrate={rate}"\n[nodes.w]\nprotocol = "{kind}"\n{address}\n'
    return read(Source("line.toml", f"{head}[nodes.w.points]\n{points}"))


def parse(kind: str, points: str) -> ConfiguredLine:
    return ConfiguredLine(file(kind, points), outputs=False)


def emulated(parsed: LineFile) -> ConfiguredLine:
    return ConfiguredLine(parsed, port=MemoryPort(emulated_line(parsed)), outputs=False)


@pytest.mark.parametrize("kind", PLACES)
@in_virtual_time
async def test_a_word_of_every_protocol_has_bits_from_one_exchange(kind: str) -> None:
    word = f'a = {{ item = "{PLACES[kind][1]}", bits = {{ READY = 0, FAULT = 3 }} }}'
    async with emulated(file(kind, word + GROUP)) as line:
        await line.point("w/a").write(9)
        async for snapshot in line.groups["axes"]:
            values = {point.key: sample.value for point, sample in snapshot.items()}
            if values["w/a"] == 9:  # not so in a cycle that had begun before the write
                break
        assert values == {"w/a": 9, "w/a.READY": 1, "w/a.FAULT": 1}
        assert str(values["w/a"]) == "9 READY|FAULT"
        assert len(line.groups["axes"].poll.results) == 1
        assert await line.point("w/a.FAULT").read() is True


@pytest.mark.parametrize("kind", PLACES)
@in_virtual_time
async def test_a_number_of_every_protocol_has_labels_precision_and_limits(kind: str) -> None:
    item = PLACES[kind][1]
    points = f'a = {{ item = "{item}", labels = {{ 2 = "on" }} }}\nb = {{ item = "{item}", precision = 1, high = 1 }}'
    async with emulated(file(kind, points + GROUP.replace("w/a", "w/a,b"))) as line:
        alarms = (event async for event in line.bus.events() if isinstance(event, AlarmChanged))
        await line.point("w/a").write(2)
        value = await line.point("w/a").read()
        assert isinstance(value, Named)
        assert (value, value.label) == (2, "on")
        assert line.point("w/b").meaning.precision == 1
        assert (await anext(alarms)).text == "w/b = 2 is above its high of 1"


def test_a_plan_calculates_bits_as_one_exchange() -> None:
    word = 'a = { item = "10"BITS }' + GROUP
    bits = parse("hcp2", word.replace("BITS", ", bits = { READY = 0, FAULT = 3 }"))
    assert len(bits.members("axes")) == 3
    assert bits.plan().utilisation == parse("hcp2", word.replace("BITS", "")).plan().utilisation


def test_one_bit_may_be_polled_without_its_word() -> None:
    line = parse("hcp2", 'a = { item = "10", bits = { A1-3 = 0, FAULT = 3 } }' + GROUP.replace("w/a", "w/a.A1-3"))
    assert [point.key for point in line.members("axes")] == ["w/a.A1-3"]


def test_a_bit_of_a_point_whose_name_has_a_dot_is_found() -> None:
    word = '"drive.status" = { item = "10", bits = { READY = 0 } }' + GROUP.replace("w/a", "w/drive.status")
    line = parse("hcp2", word)
    assert [point.key for point in line.members("axes")] == ["w/drive.status", "w/drive.status.READY"]
    assert line.point("w/drive.status.READY").bits == ()


def test_bits_are_told_to_outputs_as_their_word_is() -> None:
    line = parse("hcp2", 'a = { item = "10", bits = { READY = 0 }, deadband = 0, heartbeat = 60 }')
    assert line.point("w/a.READY").meaning == Meaning(deadband=0, heartbeat=60)


def test_a_bit_cannot_be_written_nor_allowed_to_be() -> None:
    word = 'a = { item = "10", bits = { READY = 0 } }\n'
    assert not parse("hcp2", word).point("w/a.READY").writable
    with pytest.raises(FileError, match=r"line.toml:8: outputs.mqtt.allow_commands\[1\]: w/a.READY is read-only"):
        ConfiguredLine(file("hcp2", f'{word}[outputs.mqtt]\nallow_commands = "w/a.READY"\n'.replace("\n\n", "\n")))


@in_virtual_time
async def test_what_points_mean_is_taken_from_a_file_that_is_read_again() -> None:
    word = 'a = { item = "10", bits = { READY = 0 } }'
    async with emulated(file("hcp2", word + GROUP)) as line:
        before = line.point("w/a.READY")
        await line.take(file("hcp2", word + GROUP))
        assert line.point("w/a.READY") is before
        await line.take(file("hcp2", word.replace("READY = 0", "READY = 1") + GROUP))
        assert line.point("w/a.READY") is not before
        await line.point("w/a").write(2)
        assert await line.point("w/a.READY").read() is True
        assert [point.key for point in line.groups["axes"].points] == ["w/a", "w/a.READY"]


@in_virtual_time
async def test_an_alarm_ends_where_the_file_watches_no_more() -> None:
    speed = 'a = { item = "10", high = 5 }'
    async with emulated(file("hcp2", speed + GROUP)) as line:
        events = line.bus.events()
        await line.point("w/a").write(6)
        alarms = (event async for event in events if isinstance(event, AlarmChanged))
        assert (await anext(alarms)).active
        await line.take(file("hcp2", speed.replace(", high = 5", "") + GROUP))
        ended = await anext(alarms)
        assert (ended.active, ended.value) == (False, None)


def test_every_key_of_a_point_is_in_one_list() -> None:
    assert {part.name for part in fields(Meaning)} < set(POINT_KEYS)
    with pytest.raises(FileError) as refused:
        parse("hcp2", 'a = { item = "10", xyzzy = 1 }')
    assert all(key in str(refused.value) for key in POINT_KEYS)


@pytest.mark.parametrize("key", POINT_KEYS)
def test_a_mistyped_key_is_named_with_its_line_and_the_one_that_was_meant(key: str) -> None:
    with pytest.raises(FileError, match=rf"line.toml:6: nodes.w.points.a.{key}x: no such key; did you mean '{key}'"):
        parse("hcp2", f"a = {{ {key}x = 1 }}")


@pytest.mark.parametrize(
    ("kind", "said", "complaint"),
    [
        ("hcp2", 'item = "10", precision = 1.5', "precision: must be a whole number, not 1.5"),
        ("hcp2", 'item = "10", precision = -1', "precision: must be 0 to 15, not -1"),
        ("hcp2", 'item = "10", precision = "1"', "precision: must be a whole number, not '1'"),
        ("hcp2", 'item = "10", bits = {}', "bits: must be a table of names: { READY = 0 }, not an empty table"),
        ("hcp2", 'item = "10", bits = [0]', "bits: must be a table of names: { READY = 0 }, not a list"),
        ("hcp2", 'item = "10", bits = { READY = "0" }', "bits.READY: must be a whole number, not '0'"),
        ("hcp2", 'item = "10", bits = { READY = -1 }', "bits.READY: must be 0 to "),
        ("hcp2", 'item = "10", bits = { READY = 32 }', "bits: READY is bit 32, but the highest bit of 10 is 31"),
        ("hcp2", 'item = "10", bits = { A = 0, B = 0 }', "bits: B and A are the same bit, 0"),
        ("hcp2", 'item = "10", bits = { "a b" = 0 }', "bits: the name of a bit begins with a letter"),
        ("hcp2", 'item = "axis0.position", bits = { A = 0 }', "bits: need whole numbers, but axis0.position has dec"),
        (
            "hcp2",
            'item = "10", factor = 0.1, bits = { A = 0 }',
            "bits: apply to the unscaled number on the line; leave",
        ),
        (
            "hcp2",
            'item = "10", offset = 1, labels = { 0 = "x" }',
            "labels: apply to the unscaled number on the line; leave",
        ),
        ("mentor", 'item = "8.77", decimals = 1, bits = { A = 0 }', "bits: need whole numbers, but 8.77 has decimals"),
        (
            "modbus",
            'item = "holding:1", labels = { 65536 = "x" }',
            "labels: holding:1 cannot be 65536, because it has 16 b",
        ),
        (
            "modbus",
            'item = "holding:1", labels = { -32769 = "x" }',
            "labels: holding:1 cannot be -32769, because it has 1",
        ),
        ("modbus", 'item = "holding:1:4", max_step = 1', "max_step: is not possible for holding:1:4, a run of values"),
        ("hcp2", 'item = "10", bits = { A = 0 }, labels = { 0 = "x" }', "labels: a number has bits or labels, not bo"),
        ("mentor", 'item = "1.17", bits = { A = 16 }', "bits: A is bit 16, but the highest bit of 1.17 is 15"),
        (
            "mentor",
            'item = "1.17:20", bits = { A = 1 }',
            "bits: is not possible for 1.17:20, a run of values; make each",
        ),
        ("ct-ansi", 'item = "1.21:8", low = 1', "low: is not possible for 1.21:8, a run of values; make each"),
        ("dc104", 'item = "12", bits = { A = 16 }', "bits: A is bit 16, but the highest bit of 12 is 15"),
        (
            "modbus",
            'item = "holding:1", bits = { A = 16 }',
            "bits: A is bit 16, but the highest bit of holding:1 is",
        ),
        ("modbus", 'item = "holding:1:float32", bits = { A = 1 }', "bits: need whole numbers, but holding:1:float32"),
        ("modbus", 'item = "holding:1:4", minimum = 1', "minimum: is not possible for holding:1:4, a run of values"),
        ("modbus", 'item = "coil:1", bits = { A = 1 }', "bits: A is bit 1, but the highest bit of coil:1 is 0"),
        (
            "modbus",
            'item = "coil:1", high = 0.5',
            "high: is not possible for coil:1, which is a bit and not a quantity; for each of its changes, and these",
        ),
        ("modbus", 'item = "coil:1", deadband = 0.5', "deadband: of a bit must be 0, because every change is reported"),
        ("microflex", 'item = "status_word", deadband = 2', "deadband: of a word must be 0, because every change"),
        ("msc", 'item = "flags", deadband = 2', "deadband: of a set must be 0, because every change is reported"),
        ("modbus", 'item = "coil:1", labels = { 2 = "x" }', "labels: coil:1 cannot be 2, because it has 1 bit"),
        ("msc", 'item = "flags", bits = { A = 256 }', "bits: A is bit 256, but the highest bit of flags is 255"),
        ("msc", 'item = "flags", high = 1', "high: is not possible for flags, which is a set and not a quantity"),
        ("msc", 'item = "status", bits = { A = 16 }', "bits: A is bit 16, but the highest bit of status is 15"),
        ("msc", 'item = "2008:32", labels = { 0 = "x" }', "labels: is not possible for 2008:32, a run of values"),
        (
            "microflex",
            'item = "status_word", high = 1',
            "high: is not possible for status_word, which is a word and not",
        ),
        ("hcp2", 'item = "10", labels = { on = "1" }', 'labels.on: labels are of whole numbers: { 0 = "off" }, not of'),
        ("hcp2", 'item = "10", labels = { 0 = 1 }', "labels.0: must be a text in quotes, not 1"),
        (
            "hcp2",
            'item = "10", labels = { 0 = "a", 00 = "b" }',
            "labels: define a number twice; leave out one of the labels",
        ),
        (
            "msc",
            'item = "flags", labels = { 0 = "x" }',
            "labels: is not possible for flags, which is a set of flags; name",
        ),
        ("hcp2", 'item = "10", labels = { 0 = "" }', "labels: the label of 0 is a text on one line, not ''"),
        ("hcp2", 'item = "axis0.position", labels = { 0 = "x" }', "labels: need whole numbers, but axis0.position"),
        ("mentor", 'item = "1.17", decimals = 1, labels = { 0 = "x" }', "labels: need whole numbers, but 1.17 has"),
        (
            "hcp2",
            'item = "10", labels = { 0 = "x" }, low = 1',
            "low: is for quantities, and this number has labels; for each of its changes, and these alone, write",
        ),
        ("hcp2", 'item = "10", deadband = -1', "deadband: is 0 or more, not -1"),
        ("hcp2", 'item = "10", deadband = "1"', "deadband: must be a number, not '1'"),
        ("hcp2", 'item = "10", heartbeat = 0', "heartbeat: is more than 0 seconds, not 0; leave it out for none"),
        ("hcp2", 'item = "10", low = 2, high = 1', "low: 2 must be below high, which is 1"),
        ("hcp2", 'item = "10", low = nan', "low: must be finite, not nan"),
        ("hcp2", 'item = "10", low = -inf', "low: must be finite, not -inf"),
        ("hcp2", 'item = "10", high = inf', "high: must be finite, not inf"),
        ("hcp2", 'item = "10", hysteresis = 1', "hysteresis: is of low and high: write one of them, or leave it out"),
        ("hcp2", 'item = "10", high = 1, hysteresis = -1', "hysteresis: is 0 or more, not -1"),
        ("hcp2", 'item = "10", low = 0, high = 1, hysteresis = 2', "hysteresis: must be less than the 1 between low"),
        ("dc104", 'item = "12", decimals = 2', "decimals: dc104 has no implied decimals; use factor = 0.01"),
        ("dc104", 'item = "12", decimals = 9', "decimals: dc104 has no implied decimals; use factor = 0.000000001 to"),
        ("ct-ansi", 'item = "1.21", decimals = 10', "decimals: must be 0 to 9, not 10"),
    ],
)
def test_what_means_nothing_is_one_sentence_with_line_and_key(kind: str, said: str, complaint: str) -> None:
    with pytest.raises(FileError) as refused:
        parse(kind, f"a = {{ {said} }}")
    assert str(refused.value).startswith(f"line.toml:6: nodes.w.points.a.{complaint}")


@pytest.mark.parametrize("said", ["deadband = 0.5", "low = 1", "precision = 1", 'labels = { 0 = "x" }'])
def test_a_text_has_nothing_of_a_number(said: str) -> None:
    section = file("hcp2", f'a = {{ item = "10", {said} }}').nodes["w"].points["a"]
    text: Point[Any] = replace(parse("hcp2", "").nodes["w"].point("10"), decode=str)
    with pytest.raises(FileError, match="is not possible for 10, which is a text"):
        check_suits(section, text, find("hcp2"))


@pytest.mark.parametrize(("decode", "sort"), [(str, "text"), (lambda value: b"\0", "text"), (lambda value: [1], "run")])
def test_what_is_no_number_is_known_before_it_is_read(decode: Callable[[Any], Any], sort: str) -> None:
    point: Point[Any] = replace(parse("hcp2", "").nodes["w"].point("10"), decode=decode)
    assert sort_of(point, find("hcp2")) == sort


@pytest.mark.parametrize("number", ["int32", "uint32", "int64", "uint64", "float32", "float64"])
def test_a_number_of_any_width_is_a_quantity(number: str) -> None:
    limits = "minimum = -5, maximum = 5, max_step = 2, low = -3, high = 3, hysteresis = 1"
    point = f'a = {{ item = "holding:40:{number}", {limits}, precision = 1, deadband = 0.5 }}'
    metrics = f'{GROUP}[outputs.metrics]\ngroups = "axes"\n'  # a gauge cannot show a set of flags
    meaning = ConfiguredLine(file("modbus", point + metrics)).point("w/a").meaning
    assert (meaning.precision, meaning.low, meaning.high, meaning.deadband) == (1, -3, 3, 0.5)


@pytest.mark.parametrize(
    ("number", "key", "complaint"),
    [
        ("int64", "labels = { -9223372036854775808 = 'least', 9223372036854775807 = 'most' }", None),
        ("uint64", "labels = { 18446744073709551615 = 'most' }", None),
        ("uint64", "bits = { LOWEST = 0, HIGHEST = 63 }", None),
        ("int64", "labels = { -9223372036854775809 = 'x' }", "labels: holding:40:int64 cannot be -9223372036854775809"),
        ("uint64", "labels = { 18446744073709551616 = 'x' }", "labels: holding:40:uint64 cannot be 184467440737095516"),
        ("uint64", "bits = { A = 64 }", "bits: A is bit 64, but the highest bit of holding:40:uint64 is 63"),
        ("float64", "labels = { 0 = 'x' }", "labels: need whole numbers, but holding:40:float64 has decimals"),
        ("float64", "bits = { A = 0 }", "bits: need whole numbers, but holding:40:float64 has decimals"),
    ],
)
def test_a_number_of_64_bits_has_labels_or_bits_if_it_is_whole(number: str, key: str, complaint: str | None) -> None:
    point = f'a = {{ item = "holding:40:{number}", {key} }}'
    if complaint is None:
        assert parse("modbus", point).point("w/a").meaning != Meaning()
        return
    with pytest.raises(FileError) as refused:
        parse("modbus", point)
    assert str(refused.value).startswith(f"line.toml:6: nodes.w.points.a.{complaint}")


def test_a_text_may_be_told_by_exception() -> None:
    section = file("hcp2", 'a = { item = "10", deadband = 0, heartbeat = 60 }').nodes["w"].points["a"]
    text: Point[Any] = replace(parse("hcp2", "").nodes["w"].point("10"), decode=str)
    check_suits(section, text, find("hcp2"))


def test_the_line_is_that_of_the_key_in_a_table_of_its_own() -> None:
    with pytest.raises(FileError, match=r"line.toml:9: nodes.w.points.a.low: 7 must be below high"):
        parse("hcp2", '[nodes.w.points.a]\nitem = "10"\nhigh = 3\nlow = 7\n')


@pytest.mark.parametrize("points", ['"a.READY" = { item = "11" }\na = {', "axis0 = {"])
def test_a_bit_takes_no_name_that_something_else_has(points: str) -> None:
    with pytest.raises(FileError, match=r"bits\.\w+: w has another point or item \w+\.\w+"):
        parse("hcp2", f'{points} item = "10", bits = {{ READY = 0, position = 1 }} }}')


def test_a_bit_that_was_not_named_is_guessed() -> None:
    with pytest.raises(FileError, match=r"no such item 'a.REDY'; did you mean 'a.READY'\?"):
        parse("hcp2", 'a = { item = "10", bits = { READY = 0 } }' + GROUP.replace("w/a", "w/a.REDY"))
    with pytest.raises(InvalidCommand, match=r"did you mean 'a.READY'\?"):
        parse("hcp2", 'a = { item = "10", bits = { READY = 0 } }').point("w/a.REDY")


@pytest.mark.parametrize(
    ("kind", "point", "output", "complaint"),
    [
        ("modbus", '"holding:1:4"', 'metrics]\ngroups = "axes"', "metrics.groups: cannot take w/a: it is a run, and"),
        ("msc", '"flags"', 'metrics]\ngroups = "axes"', "metrics.groups: cannot take w/a: it is a set, and a gauge"),
        ("msc", '"2008:32"', 'metrics]\ngroups = "axes"', "metrics.groups: cannot take w/a: it is a run, and a gauge"),
        ("hcp2", '"10"', 'csv]\npath = "%Q-line.csv"', "csv: %Q-line.csv: %Q is not a field of a date; use strf"),
        ("hcp2", '"10"', 'mqtt]\nprefix = "a\\u0001"', "mqtt.prefix: a topic must not contain"),
    ],
)
def test_an_output_that_cannot_take_a_point_says_so(kind: str, point: str, output: str, complaint: str) -> None:
    with pytest.raises(FileError, match=rf"outputs\.{complaint}"):
        ConfiguredLine(file(kind, f"a = {{ item = {point} }}{GROUP}[outputs.{output}\n"))


@pytest.mark.parametrize("messages", ["point", "cycle"])
@pytest.mark.parametrize(
    ("name", "complaint"), [("b\\u0001", "has no control characters"), ("b" * 30_000, "longer than a topic may be")]
)
def test_a_name_that_is_no_topic_is_refused_before_a_broker_does(messages: str, name: str, complaint: str) -> None:
    group, point = (f'"{name}"', "b") if messages == "cycle" else ("g", name)
    text = f'"{point}" = {{ item = "10" }}\n[groups.{group}]\nperiod = 1\npoints = "w/{point}"\n'
    with pytest.raises(FileError, match=complaint):
        ConfiguredLine(file("hcp2", f'{text}[outputs.mqtt]\nmessages = "{messages}"\n'))


def test_a_run_of_values_has_precision_deadband_and_heartbeat() -> None:
    run = parse("msc", 'a = { item = "2008:4", precision = 1, deadband = 2, heartbeat = 60 }').point("w/a")
    assert run.meaning == Meaning(precision=1, deadband=2, heartbeat=60)


def test_a_point_without_a_unit_of_its_own_has_that_of_its_item() -> None:
    line = parse("mentor", 'a = { item = "speed_reference_1" }\nb = { item = "speed_reference_1", unit = "rpm" }')
    assert (line.point("w/a").unit, line.point("w/b").unit) == ("%", "rpm")


def test_metrics_take_one_flag_of_a_set_and_counts_take_all() -> None:
    flags = 'a = { item = "flags", bits = { READY = 3 } }'
    one = GROUP.replace("w/a", "w/a.READY") + '[outputs.metrics]\ngroups = "axes"\n'
    assert ConfiguredLine(file("msc", flags + one)).members("axes")
    assert ConfiguredLine(file("msc", flags + GROUP + "[outputs.metrics]\n")).members("axes")


def test_an_empty_group_and_milliseconds_for_seconds_are_errors() -> None:
    with pytest.raises(FileError, match="a group without points polls nothing"):
        parse("hcp2", "[groups.axes]\nperiod = 1\npoints = []")
    with pytest.raises(FileError, match=r"must be at most 10, in seconds; for 50 ms write 0\.05"):
        parse("hcp2", "[nodes.w.timing]\nlate_after = 50")


@in_virtual_time
async def test_a_value_that_was_read_is_the_same_whatever_digits_are_shown() -> None:
    async with emulated(file("hcp2", 'a = { item = "10", precision = 0 }' + GROUP)) as line:
        await line.point("w/a").write(1.2345)
        assert await line.point("w/a").read(max_age=inf) == 1.2345


def templated(kind: str, own: str, word: str, emulator: str) -> ConfiguredLine:
    """Return an emulated line with one node of a shipped template, whose word is polled."""
    rate = 9600 if kind == "msc" else 57600
    text = (
        f'port = "/dev/ttyUSB0?baudrate={rate}"\n[nodes.w]\nprotocol = "{kind}"\naddress = 3\ntemplate = "{kind}"\n'
        f'{own}[groups.axes]\nperiod = 0.2\npoints = "w/{word}"\n[emulator.nodes.w]\n{emulator}'
    )
    return emulated(read(Source("line.toml", text)))


@in_virtual_time
async def test_the_template_of_a_microflex_reports_a_trip() -> None:
    async with templated("microflex", "", "status_word", "axis_error = 2\ntrips_after = 1.5\n") as line:
        alarms = (event async for event in line.bus.events() if isinstance(event, AlarmChanged))
        assert (await anext(alarms)).text == "w/status_word.ASYNCHRONOUS_ERROR is set"
        assert {point.key: alarm and alarm.limit for point, alarm in line.bus.alarms.items()} == {
            "w/status_word.ASYNCHRONOUS_ERROR": "high"
        }
        await line.nodes["w"].write("command_word", 64)
        assert (await anext(alarms)).text == "w/status_word.ASYNCHRONOUS_ERROR is clear again, was set"


@in_virtual_time
async def test_the_template_of_an_msc_reports_a_program_that_does_not_run() -> None:
    async with templated("msc", "", "status", "[emulator.nodes.w.values]\nstatus = 64\n") as line:
        alarms = (event async for event in line.bus.events() if isinstance(event, AlarmChanged))
        assert (await anext(alarms)).text == "w/status.PROGRAM_RUNNING is clear"
        assert [point.key for point, alarm in line.bus.alarms.items() if alarm is not None] == [
            "w/status.PROGRAM_RUNNING"
        ]


def test_an_alarm_of_a_template_is_switched_off_in_the_node() -> None:
    own = "[nodes.w.points]\nstatus = { alarm_if_clear = [] }\n"
    line = templated("msc", own, "status", "")
    watched = {bit.item for bit in line.point("w/status").bits if bit.meaning.watched}
    assert "status.PROGRAM_RUNNING" not in watched
    assert "status.BATTERY_LOW" in watched


def test_an_alarm_of_a_bit_that_there_is_not_is_an_error_at_its_key() -> None:
    point = 'a = { item = "10", bits = { FAULT = 3 }, alarm_if_set = ["FALT"] }'
    with pytest.raises(FileError, match=r"line.toml:6: nodes.w.points.a.alarm_if_set: 'FALT' is not the name of a bit"):
        parse("hcp2", point)
