"""Files of parameter sets: what is wrong is named with its line, and an interrupted save goes on."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from busmaster import Bus, MemoryPort
from busmaster.app.config.sections import read
from busmaster.app.config.source import FileError, Source
from busmaster.app.line import ConfiguredLine, parameter_sets
from busmaster.app.line.parameter_sets import PartFile, line_parameters, read_set, write_set
from busmaster.bus.parameters import LAST, Entry, Found, Parameter, ParameterSet
from busmaster.emulator.line import Line
from busmaster.errors import InvalidCommand
from busmaster.registry import find

KIND = find("mentor")
WANTED = [Parameter(item="1.17", unit="%", decimals=1), Parameter(item="1.18"), Parameter(item="1.19")]
EMPTY = ParameterSet(protocol="mentor", address=11, saved=datetime(2026, 1, 31, tzinfo=UTC))


def test_a_value_is_written_in_its_unit_and_read_as_the_lines_number(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    whole = ParameterSet(protocol="mentor", address=11, saved=EMPTY.saved, entries={"1.17": Entry(WANTED[0], -476)})
    write_set(path, whole, KIND)
    assert "value = -47.6" in Path(path).read_text()
    assert read_set(path).set.entries["1.17"].value == -476
    with pytest.raises(InvalidCommand, match="not overwritten"):
        write_set(path, whole, KIND)


def test_a_value_with_more_decimals_than_its_parameter_is_rounded_as_the_line_carries_it(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    write_set(str(path), replace(EMPTY, entries={"1.17": Entry(WANTED[0], -476)}), KIND)
    for written, number in (("-47.64", -476), ("-47.65", -477), ("-47", -470)):
        path.write_text(path.read_text().replace(path.read_text().partition("value = ")[2].split(",")[0], written))
        assert repr(read_set(str(path)).set.entries["1.17"].value) == str(number)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("value = -47.6", "valeu = -47.6", "parameters.1.17.valeu: no such key"),
        ("value = -47.6", 'value = "x"', "parameters.1.17.value: must be a number"),
        ('"mentor"', '"mentr"', "drive.protocol: no such protocol"),
        ("format = 1", "format = 2", "format: the set has format 2, and this version of busmaster reads 1"),
        ("2026-01-31T00:00:00Z", "2026-01-31T00:00:00", "saved.time: must be a date and time with its zone"),
        ("2026-01-31T00:00:00Z", '"today"', "saved.time: must be a date and time with its zone"),
        ("address = 11", "address = 100", "drive.address: must be 0 to 99, not 100"),
        ('by = ""', 'by = ""\nto = 1', "saved.to: no such key"),
        ('label = ""', "label = 5", "drive.label: must be a text"),
        ("[saved]", "[extra]\n[saved]", "extra: no such key"),
        (
            "identity = {}",
            'identity = { "11.15" = [1] }',
            "drive.identity.11.15: must be a number, true or false, not a",
        ),
        ("value = -47.6, ", "", "parameters.1.17: 'value' is missing; use a number, true or false"),
        ("decimals = 1", "decimals = 10", "parameters.1.17.decimals: must be 0 to 9, not 10"),
        ("decimals = 1", "factor = 0", "parameters.1.17: a factor must not be 0"),
        ("decimals = 1", 'access = "write"', "parameters.1.17.access: no such access 'write'"),
        ("value = -47.6", "value = [1]", "parameters.1.17.value: must be a number, true or false, not a list"),
    ],
)
def test_what_is_wrong_is_named_with_line_and_key(tmp_path: Path, old: str, new: str, what: str) -> None:
    path = tmp_path / "a.toml"
    entries = {"1.17": Entry(WANTED[0], -476)}
    write_set(str(path), ParameterSet(protocol="mentor", address=11, saved=EMPTY.saved, entries=entries), KIND)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FileError, match=what) as error:
        read_set(str(path))
    assert error.value.line > 0


def test_an_interrupted_save_goes_on_without_the_line_that_was_cut(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    with PartFile(str(path), EMPTY, WANTED, KIND) as part:
        part.add(Found(WANTED[0], -476))
        part.add(Found(WANTED[1], why="no such parameter", gap=True))
    beside = tmp_path / "a.toml.part"
    beside.write_bytes(beside.read_bytes() + b'"1.19" = { val')
    with PartFile(str(path), EMPTY, WANTED, KIND) as part:
        assert [one.item for one in part.missing] == ["1.19"]
        part.add(Found(WANTED[2], 3))
    part.finish()
    assert {item: one.value for item, one in read_set(str(path)).set.entries.items()} == {"1.17": -476, "1.19": 3}
    assert not beside.exists()


def test_a_save_that_is_interrupted_twice_goes_on_each_time(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    beside = tmp_path / "a.toml.part"
    for number, one in enumerate(WANTED):
        with PartFile(str(path), EMPTY, WANTED, KIND) as part:
            assert [missing.item for missing in part.missing] == [missing.item for missing in WANTED[number:]]
            part.add(Found(one, number))
        beside.write_bytes(beside.read_bytes() + b'"1.19" = { val')
    with PartFile(str(path), EMPTY, WANTED, KIND) as part:
        assert part.missing == ()
    assert [entry.value for entry in part.finish().entries.values()] == [0, 1, 2]


def test_what_was_begun_with_another_list_is_not_gone_on_with(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    with PartFile(path, EMPTY, WANTED, KIND):
        pass
    with pytest.raises(InvalidCommand, match="other parameters"):
        PartFile(path, EMPTY, WANTED[:2], KIND)


FULL = Parameter(
    item="1.18", name="Preset", unit="A", access="read", decimals=1, factor=2, offset=3, minimum=-5.5, maximum=40.0
)


def test_a_set_is_read_as_it_was_written_with_all_that_its_file_contains(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    written = replace(
        EMPTY,
        label="node 11",
        line="/dev/ttyUSB0",
        by='PLANT\\maria "m"@press',
        identity={"11.15": 530},
        entries={"1.18": Entry(FULL, 50), "1.19": Entry(WANTED[2], True)},
    )
    write_set(str(path), written, KIND)
    assert read_set(str(path)).set == written
    [line] = [line for line in path.read_text().splitlines() if line.startswith('"1.18"')]
    assert "value = 13.0" in line  # 50 / 10 x 2 + 3
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("minimum", "maximum"), [(0, 0), (0.0, None), (None, 0.0), (-5.5, 0.0), (0.0, 40.0)])
def test_a_range_that_ends_at_zero_is_kept_in_its_file(
    tmp_path: Path, minimum: float | None, maximum: float | None
) -> None:
    path = str(tmp_path / "a.toml")
    parameter = replace(WANTED[1], minimum=minimum, maximum=maximum)
    outside = {0: "", -1: "minimum", 1: "maximum"}
    for value, limit in outside.items():
        Path(path).unlink(missing_ok=True)
        write_set(path, replace(EMPTY, entries={"1.18": Entry(parameter, value)}), KIND)
        file = read_set(path)
        assert file.set.entries["1.18"].parameter == parameter
        is_beyond = (value < 0 and minimum == 0) or (value > 0 and maximum == 0)
        beyond = pytest.raises(FileError, match=f"{value} is beyond its {limit} of 0") if is_beyond else nullcontext()
        with beyond:
            file.check_range("1.18")


def test_what_a_parameter_does_not_define_is_not_in_its_file(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    write_set(str(path), replace(EMPTY, entries={"1.18": Entry(replace(WANTED[1], access="write"), 0)}), KIND)
    assert path.read_text().endswith('\n"1.18" = { value = 0 }\n')


@pytest.mark.parametrize(
    ("value", "beyond"),
    [
        (-5.4, ""),
        (-5.5, ""),
        (40.0, ""),
        (-5.6, "-5.6 is beyond its minimum of -5.5"),
        (40.2, "40.2 is beyond its maximum of 40.0"),
    ],
)
def test_a_value_beyond_the_range_in_its_file_is_an_error_at_the_value(
    tmp_path: Path, value: float, beyond: str
) -> None:
    path = tmp_path / "a.toml"
    parameter = replace(FULL, factor=1, offset=0)
    write_set(str(path), replace(EMPTY, entries={"1.18": Entry(parameter, 50)}), KIND)
    path.write_text(path.read_text().replace("value = 5.0", f"value = {value}"))
    file = read_set(str(path))
    with pytest.raises(FileError, match=f"parameters.1.18.value: {beyond}$") if beyond else nullcontext():
        file.check_range("1.18")


def test_a_set_of_another_kind_of_node_or_with_an_item_that_it_does_not_have_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    write_set(str(path), replace(EMPTY, entries={one.item: Entry(one, 1) for one in WANTED}), KIND)
    port = MemoryPort(Line(KIND.profile.line, []))
    handle = KIND.handle(Bus(port), 11)
    read_set(str(path)).check(handle)
    with pytest.raises(FileError, match=r"drive.protocol: .* is a hcp2, but the set belongs to a mentor; use a set of"):
        read_set(str(path)).check(find("hcp2").handle(Bus(port), 1))
    path.write_text(path.read_text().replace('"1.19"', '"1.190"'))
    with pytest.raises(FileError, match=r"a.toml:\d+: parameters.1.190: "):
        read_set(str(path)).check(handle)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_set_that_cannot_be_written_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def full(_: object) -> None:
        raise error

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(type(error)):
        write_set(str(tmp_path / "a.toml"), EMPTY, KIND)
    assert not list(tmp_path.iterdir())


def test_what_a_killed_save_left_beside_a_set_is_not_in_the_next_one(tmp_path: Path) -> None:
    (tmp_path / "a.toml.new").write_text("x" * 10_000)
    write_set(str(tmp_path / "a.toml"), EMPTY, KIND)
    assert read_set(str(tmp_path / "a.toml")).set == EMPTY
    assert [one.name for one in tmp_path.iterdir()] == ["a.toml"]


def test_a_save_whose_set_cannot_be_written_keeps_what_it_has_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object) -> None:
        raise OSError(28, "No space left on device")

    path = str(tmp_path / "a.toml")
    with PartFile(path, EMPTY, WANTED[:1], KIND) as part:
        part.add(Found(WANTED[0], -476))
        with monkeypatch.context() as patch:
            patch.setattr("os.fsync", full)
            with pytest.raises(OSError, match="No space left"):
                part.finish()
    with PartFile(path, EMPTY, WANTED[:1], KIND) as part:
        assert part.missing == ()
        assert part.finish().entries["1.17"].value == -476


def test_each_parameter_is_in_the_file_as_soon_as_it_is_read(tmp_path: Path) -> None:
    """A save that is killed has lost nothing."""
    with PartFile(str(tmp_path / "a.toml"), EMPTY, WANTED, KIND) as part:
        for one in WANTED:
            part.add(Found(one, 5))
            assert f'\n"{one.item}" = ' in (tmp_path / "a.toml.part").read_text()


def test_a_save_to_a_file_that_exists_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("")
    with pytest.raises(InvalidCommand, match="is not overwritten; choose another name"):
        PartFile(str(path), EMPTY, WANTED, KIND)
    assert list(tmp_path.iterdir()) == [path]


def test_a_save_of_another_node_is_not_continued(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    with PartFile(path, replace(EMPTY, label="node 11"), WANTED, KIND):
        pass
    others = {"address": 12, "identity": {"11.15": 530}, "protocol": "ct-ansi"}
    for other in (replace(EMPTY, **{key: value}) for key, value in others.items()):  # type: ignore[arg-type]
        with pytest.raises(InvalidCommand, match=r"started with another node \(node 11\); remove .*a.toml.part"):
            PartFile(path, other, WANTED, KIND)


@pytest.mark.parametrize("line", ['"9.99" = { value = 1 }', '"9.99" = { why = "no reply", gap = true }'])
def test_a_save_with_a_parameter_that_is_not_in_its_list_is_not_continued(tmp_path: Path, line: str) -> None:
    path = str(tmp_path / "a.toml")
    with PartFile(path, EMPTY, WANTED, KIND) as part:
        part.add(Found(WANTED[0], 5))
    with (tmp_path / "a.toml.part").open("a") as file:
        file.write(f"{line}\n")
    with pytest.raises(InvalidCommand, match=r"a parameter that is not in its list, 9.99; remove .*a.toml.part"):
        PartFile(path, EMPTY, WANTED, KIND)


def test_a_save_that_was_interrupted_before_its_first_parameter_starts_again(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    with PartFile(str(path), EMPTY, WANTED, KIND):
        pass
    part = tmp_path / "a.toml.part"
    part.write_text(part.read_text().partition("[saved]")[0])
    with PartFile(str(path), EMPTY, WANTED, KIND) as fresh:
        assert fresh.missing == tuple(WANTED)
        for one in reversed(WANTED):
            fresh.add(Found(one, 5))
    assert list(fresh.finish().entries) == [one.item for one in WANTED]  # in the order of the list
    assert list(read_set(str(path)).set.entries) == [one.item for one in WANTED]


def test_a_save_that_started_again_goes_on_when_it_is_interrupted_again(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    (tmp_path / "a.toml.part").write_text("# of the list\n")
    with PartFile(path, EMPTY, WANTED, KIND) as part:
        part.add(Found(WANTED[0], 5))
    with PartFile(path, EMPTY, WANTED, KIND) as part:
        assert part.missing == (*WANTED[1:],)


def test_a_continued_save_keeps_its_start_and_why_parameters_have_no_value(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    with PartFile(path, EMPTY, WANTED, KIND) as part:
        part.add(Found(WANTED[0], why="no such parameter", gap=True))
        part.add(Found(WANTED[1], why="no reply"))
        assert [one.item for one in part.missing] == ["1.19"]
        part.add(Found(WANTED[2], 7))
        assert part.missing == ()
    later = replace(EMPTY, saved=datetime(2026, 2, 28, tzinfo=UTC))
    with PartFile(path, later, WANTED, KIND) as part:
        assert part.missing == ()
        assert part.gaps == {
            "1.17": Found(WANTED[0], why="no such parameter", gap=True),
            "1.18": Found(WANTED[1], why="no reply"),
        }
    done = part.finish()
    assert done.saved == EMPTY.saved
    assert done == read_set(path).set
    assert done.entries == {"1.19": Entry(WANTED[2], 7)}


TEXT = """
port = "/dev/ttyUSB0"
[nodes.screw]
protocol = "mentor"
address = 11
points.ramp = { item = "2.04", unit = "s", decimals = 1, minimum = 0.5, maximum = 20 }
points.same = { item = "2.04", unit = "min", decimals = 1 }
points."2.05" = { factor = 3, offset = 1, writable = false }
points.run = { item = "1.17:2" }
"""


def test_parameters_of_a_line_are_those_of_the_document_with_what_the_file_adds() -> None:
    line = ConfiguredLine(read(Source("line.toml", TEXT)), outputs=False)
    handle = line.nodes["screw"]
    listed = line_parameters(line, "screw", handle)
    found = {one.item: one for one in listed}
    document = {one.item: one for one in handle.parameters()}
    assert [one.item for one in listed] == list(document), "each once, in the order of the document"
    assert {item for item in document if found[item] != document[item]} == {"2.04", "2.05"}
    ramp = found["2.04"]
    assert (ramp.name, ramp.unit, ramp.decimals, ramp.minimum, ramp.maximum) == ("ramp", "s", 1, 0.5, 20)
    assert (ramp.kept, ramp.stage, ramp.access) == ("", document["2.04"].stage, document["2.04"].access)
    other = found["2.05"]
    assert (other.name, other.factor, other.offset) == (document["2.05"].name, 3, 1)
    assert other.kept == "LINE.toml has writable = false"


def test_a_run_of_the_file_keeps_no_point_behind_it_out_of_the_set() -> None:
    run, rest = 'points.run = { item = "1.17:2" }\n', TEXT.partition("points.run")[0]
    line = ConfiguredLine(read(Source("line.toml", rest.replace("points.ramp", f"{run}points.ramp"))), outputs=False)
    found = {one.item: one for one in line_parameters(line, "screw", line.nodes["screw"])}
    assert "1.17:2" not in found
    assert (found["2.04"].name, found["2.04"].minimum) == ("ramp", 0.5)


def test_items_of_a_parameter_set_can_be_named_as_the_points_of_the_file() -> None:
    line = ConfiguredLine(read(Source("line.toml", TEXT)), outputs=False)
    found = line_parameters(line, "screw", line.nodes["screw"], ["ramp", "1.17"])
    assert [(one.item, one.unit) for one in found] == [("2.04", "s"), ("1.17", "%")]


def test_a_point_of_the_file_keeps_what_the_document_says_of_its_parameter() -> None:
    points = ("store = { item = '1.00' }", "address = { item = '11.11' }")
    named = "ref = { item = 'speed_reference_1', factor = 2 }"
    text = f"{TEXT.partition('points')[0]}[nodes.screw.points]\n" + "\n".join((*points, named))
    line = ConfiguredLine(read(Source("line.toml", text)), outputs=False)
    handle = line.nodes["screw"]
    document = {one.item: one for one in handle.parameters()}
    found = {one.item: one for one in line_parameters(line, "screw", handle)}
    assert found.keys() == document.keys()
    assert found["1.00"].stage == document["1.00"].stage == LAST, "the command that stores is written last"
    assert found["11.11"].kept == document["11.11"].kept != "", "a load never writes the address"
    assert (found["1.17"].name, found["1.17"].unit, found["1.17"].factor) == ("ref", "%", 2)


def test_a_parameter_that_the_document_calls_read_only_stays_so_under_a_name_of_the_file() -> None:
    head = 'port = "/dev/ttyUSB0"\n[nodes.one]\nprotocol = "ei-bisynch"\naddress = 1\n'
    line = ConfiguredLine(read(Source("line.toml", head + 'points.version = { item = "V0" }\n')), outputs=False)
    [found] = line_parameters(line, "one", line.nodes["one"], ["version"])
    assert (found.name, found.access) == ("version", "read")


def test_decimals_that_a_drive_sends_itself_are_not_those_of_its_parameter() -> None:
    text = (
        TEXT.replace('"mentor"', '"ct-ansi"').partition("points")[0] + 'points.ref = { item = "1.21", decimals = 1 }\n'
    )
    line = ConfiguredLine(read(Source("line.toml", text)), outputs=False)
    [found] = line_parameters(line, "screw", line.nodes["screw"], ["ref"])
    assert (found.item, found.decimals) == ("1.21", 0)


def test_a_point_that_only_the_file_names_is_read_only_where_its_item_is() -> None:
    text = 'port = "/dev/ttyUSB0"\n[nodes.one]\nprotocol = "modbus"\naddress = 1\n'
    points = 'points = { a = { item = "input:1" }, b = { item = "holding:1" } }\n'
    line = ConfiguredLine(read(Source("line.toml", text + points)), outputs=False)
    found = line_parameters(line, "one", line.nodes["one"])
    assert [(one.item, one.access) for one in found] == [("input:1", "read"), ("holding:1", "")]


def test_a_set_has_as_many_parameters_as_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameter_sets, "MOST_MEMBERS", 2)
    line = ConfiguredLine(read(Source("line.toml", TEXT)), outputs=False)
    handle = line.nodes["screw"]
    assert len(line_parameters(line, "screw", handle, ["1.17", "1.18"])) == 2
    with pytest.raises(InvalidCommand, match="must have at most 2 parameters"):
        line_parameters(line, "screw", handle, ["1.17", "1.18", "1.19"])
    for count in (2, 3):
        path = str(tmp_path / str(count))
        write_set(path, replace(EMPTY, entries={one.item: Entry(one, 1) for one in WANTED[:count]}), KIND)
        with pytest.raises(FileError, match="must have at most 2 parameters") if count > 2 else nullcontext():
            read_set(path)


def test_points_that_are_not_in_the_document_follow_it_and_without_either_there_is_no_set() -> None:
    head = 'port = "/dev/ttyUSB0?baudrate=9600"\n[nodes.one]\nprotocol = "{}"\naddress = 1\n'
    point = 'points.{} = {{ item = "{}" }}\n'
    for protocol, items in (("ei-bisynch", ("Q1", "Q2")), ("msc", ("2008", "2010:2"))):
        text = head.format(protocol) + "".join(point.format(f"p{item[-1]}", item) for item in items)
        line = ConfiguredLine(read(Source("line.toml", text)), outputs=False)
        handle = line.nodes["one"]
        document = [] if protocol == "msc" else [one.item for one in handle.parameters()]
        added = [item for item in items if ":" not in item]  # a run has a parameter for each of its values
        assert [one.item for one in line_parameters(line, "one", handle)] == [*document, *added]
    line = ConfiguredLine(read(Source("line.toml", head.format("msc"))), outputs=False)
    with pytest.raises(InvalidCommand, match="documents no list of parameters: name the items"):
        line_parameters(line, "one", line.nodes["one"])
