"""The line of a file, emulated as the file says: options of its nodes, and what they hold from the start."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from busmaster import LineSettings
from busmaster.app.config import FileError, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.emulator.device import Delay
from busmaster.emulator.memory import MemoryPort
from busmaster.protocols._comms import EMULATED
from busmaster.protocols._comms.mint import PROGRAMS
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import NodeKind, Option, kinds, make_device
from busmaster.testing.virtual_time import run_in_virtual_time

HEAD = 'port = "socket://127.0.0.1:5020?baudrate=57600"\n'


def node(kind: str, address: int | None, body: str = "", emulated: str = "", name: str = "n") -> str:
    """A file of one node, and what its emulator says of it."""
    said = f"address = {address}\n" if address is not None else ""
    own = f"[emulator.nodes.{name}]\n{emulated}\n" if emulated else ""
    return f'{HEAD}[nodes.{name}]\nprotocol = "{kind}"\n{said}{body}\n{own}'


def device_of(text: str) -> Any:
    return emulated_line(read(Source("line.toml", text))).devices[0]


def values_of(text: str, *points: str, after: float = 0.0) -> list[Any]:
    """What the file's own line reads from its own emulator, `after` so many seconds and a first reading of each."""
    file = read(Source("line.toml", text))

    async def ask() -> list[Any]:
        async with ConfiguredLine(file, port=MemoryPort(emulated_line(file))) as line:
            found = [await line.point(f"n/{point}").read() for point in points]
            if after:
                await asyncio.sleep(after)
                found = [await line.point(f"n/{point}").read() for point in points]
            return found

    return run_in_virtual_time(ask())


# options


def sample(option: Option, item: str = "7.05") -> Any:
    """Something that the option can be, as its argument. `item` names a table."""
    match option.kind:
        case "flag":
            return True
        case "whole":
            return 4
        case "number" | "positive":
            return 0.5
        case "share":
            return 0.25
        case "delay":
            return Delay(0.001)
        case "text":
            return option.choices[0] if option.choices else "text"
        case "numbers":
            return frozenset({3})
        case "addresses":
            return {"name": 8}
        case "tables":
            return {item: {field.name: 1 for field in option.fields if field.kind == "number"}}


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_a_device_takes_every_option_that_its_kind_declares(kind: NodeKind) -> None:
    assert kind.emulated
    options = {option.name: sample(option, kind.probe_item) for option in kind.emulated}
    make_device(kind.name, kind.profile.addresses[-1], **options)
    with pytest.raises(TypeError):
        make_device(kind.name, kind.profile.addresses[-1], nonsense=True)


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_an_option_said_of_the_node_and_its_device_is_one_and_the_same(kind: NodeKind) -> None:
    own = {option.name: option for option in kind.options}
    assert all(own[option.name] is option for option in kind.emulated if option.name in own)


def test_every_program_that_a_controller_can_run_can_be_named() -> None:
    (program,) = (option for option in EMULATED if option.name == "program")
    assert set(program.choices) == set(PROGRAMS)


def test_what_the_file_says_of_a_node_its_emulated_device_is() -> None:
    press = device_of(node("msc", 1, 'address_step = 1\nmodel = "MSC-850"'))
    assert isinstance(press, EmulatedMsc)
    assert (press.address_step, press.model) == (1, "MSC-850")
    drive = device_of(node("dc104", None, "maximum = 99\nallow_zero = true"))
    assert isinstance(drive, EmulatedDc104)
    assert drive.parameters == range(100)


def test_an_emulated_device_may_be_another_than_the_file_says_the_node_is() -> None:
    press = device_of(node("msc", 1, "address_step = 1", "address_step = 4"))
    assert press.address_step == 4


def test_what_is_said_of_a_range_of_nodes_a_table_of_one_goes_before() -> None:
    text = (
        f'{HEAD}[nodes.d4-6]\nprotocol = "mentor"\naddress = "14-16"\n'
        "[emulator]\nlively = false\n[emulator.nodes.d4-6]\nripple = 0.5\nshort_after_write = true\n"
        "values = { '1.17' = 100, '1.18' = 5 }\n"
        "[emulator.nodes.d5]\nripple = 0.25\nlively = true\nvalues = { '1.18' = 6 }\n"
    )
    drives = emulated_line(read(Source("line.toml", text))).devices
    assert [drive.ripple for drive in drives if isinstance(drive, EmulatedMentor)] == [0.5, 0.25, 0.5]
    assert [drive.short_after_write for drive in drives if isinstance(drive, EmulatedMentor)] == [True] * 3
    found = [(drive.value(117, 0.0), drive.value(118, 0.0)) for drive in drives if isinstance(drive, EmulatedMentor)]
    assert found == [(100, 5), (100, 6), (100, 5)]


def test_what_the_file_says_of_all_nodes_is_so_for_those_without_a_table_of_their_own_too() -> None:
    text = (
        f'{HEAD}[nodes.d4-6]\nprotocol = "mentor"\naddress = "14-16"\n'
        "[emulator]\nlively = false\nreply_delay = 0.03\nfaults = { lost = 0.1, late = 0.2 }\n"
        "[emulator.nodes.d5]\nfaults = { lost = 0.5 }\n"
    )
    drives = emulated_line(read(Source("line.toml", text))).devices
    assert [(drive.faults.lost, drive.faults.late) for drive in drives] == [(0.1, 0.2), (0.5, 0.2), (0.1, 0.2)]
    assert len({id(drive.faults) for drive in drives}) == 3  # those of one can be changed while it is emulated
    assert [drive.delay.low for drive in drives] == [0.03] * 3


def test_a_microflex_in_torque_mode_refuses_a_speed_and_takes_a_torque() -> None:
    drive = device_of(node("microflex", 7, emulated="current_control = true\nlively = false"))
    assert drive.writable(116)
    assert not drive.writable(118)


def test_a_drive_that_has_tripped_says_so_and_one_that_will_trip_runs_until_then() -> None:
    tripped = node("microflex", 7, emulated="axis_error = 4")
    assert [int(value) for value in values_of(tripped, "axis_error", "status_word")] == [4, 0b0100_1000]
    trips = node("microflex", 7, emulated="axis_error = 4\ndrive_error = 2\ntrips_after = 5")
    assert [int(value) for value in values_of(trips, "axis_error", "drive_error", "status_word")] == [0, 0, 0b1100_0000]
    after = values_of(trips, "axis_error", "drive_error", "status_word", after=5.0)
    assert [int(value) for value in after] == [4, 2, 0b0100_1000]


def test_a_controller_runs_the_program_that_the_file_names() -> None:
    text = node("hcp", 2, emulated="program = 'command_handshake'\nvalues = { '2' = 20, '3' = 1.5 }")
    assert values_of(text, "3", "1", after=0.1) == [1.5, 0.0]
    controller = device_of(text)
    assert controller.program is PROGRAMS["command_handshake"]


def test_parameters_that_the_file_adds_are_there_with_their_limits() -> None:
    parameters = "parameters = { '7.05-06' = { low = -5, high = 500 }, '8.10' = { wide = true, read_only = true } }"
    drive = device_of(node("mentor", 14, emulated=f"{parameters}\nvalues = {{ '7.05' = [-5, 500], '8.10' = 65535 }}"))
    assert [drive.value(parameter, 0.0) for parameter in (705, 706, 810)] == [-5, 500, 65535]
    assert not drive.parameters[810].writable
    assert drive.parameters[705].writable


# values


VALUES: list[tuple[str, str, dict[str, Any]]] = [
    (
        node(
            "hcp2",
            5,
            "points = { force = { item = '10', factor = 0.1 }, x = { item = 'axis1.position', factor = 0.001 } }",
            "values = { force = 12.5, x = 1.5, 20 = [1, 2, 3], outputs = 5, 'axis0.position' = -7 }",
        ),
        "hcp2",
        {"force": 12.5, "x": 1.5, "20": 1, "22": 3, "outputs": 5, "axis0.position": -7, "axis1.position": 1500},
    ),
    (
        node("hcp", 2, emulated="values = { 1 = 0.5, 11-12 = 7 }"),
        "hcp",
        {"1": 0.5, "2": 0, "11": 7, "12": 7},
    ),
    (
        node("microflex", 7, emulated="values = { speed_reference = 12.5, inputs = 1, firmware = 6000 }"),
        "microflex",
        {"speed_reference": 12.5, "inputs": 1, "firmware": 6000},
    ),
    (
        node(
            "msc",
            1,
            "address_step = 4\nsymbols = { count = 2008, cam = 3000, sizes = 4000 }\n"
            "points = { count = { factor = 0.001 }, lengths = { item = 'sizes:2', factor = 0.1 } }",
            "values = { count = 1.25, cam = [5, -6, 7], lengths = [0.5, 1.5], 'flag:5-6' = true, status = 72 }",
        ),
        "msc",
        {"count": 1.25, "cam:3": (5, -6, 7), "3004": -6, "flag:5": True, "flag:6": True, "flag:7": False, "status": 72}
        | {"lengths": (0.5, 1.5), "4004": 15},
    ),
    (
        node("mentor", 14, "points.ref = { item = '1.17', decimals = 1 }", "values = { ref = -47.6, '7.05' = 9 }"),
        "mentor",
        {"ref": -47.6, "1.17": -47.6, "7.05": 9, "1.18:3": (0, 0, 0)},
    ),
    (
        node("mentor", 14, "", "values = { speed_reference_1 = 12.3 }"),
        "mentor",
        {"speed_reference_1": 12.3, "1.17": 123},
    ),
    (
        node("mentor", 14, "points.w = { item = '15.60:wide', decimals = 1 }", "values = { '15.60:wide' = 5432.1 }"),
        "mentor",
        {"w": 5432.1, "15.60:wide": 5432.1},
    ),
    (
        node("ct-ansi", 12, "points.ref = { item = '1.17', decimals = 1 }", "values = { ref = -47.6, '7.05' = 9 }"),
        "ct-ansi",
        {"ref": -47.6, "7.05": 9},
    ),
    (
        node(
            "ei-bisynch",
            12,
            'template = "eurotherm-2000"\npoints.watts = { item = "tag247", factor = 0.5 }',
            "lag = 1e6\nvalues = { target_setpoint = 450.5, PV = 21.5, watts = 9, '1XP' = 7, 'SW:hex' = 255 }",
        ),
        "ei-bisynch",
        {"target_setpoint": 450.5, "process_value": pytest.approx(21.5, abs=0.2), "watts": 9.0, "XP": 7, "SW": 255},
    ),
    (
        node(
            "dc104",
            None,
            "maximum = 99\npoints = { t = { item = '30', factor = 0.1, offset = -40 } }",
            "values = { t = 25.5, 1 = 2 }",
        ),
        "dc104",
        {"t": 25.5, "30": 655, "1": 2},
    ),
    (
        node(
            "modbus",
            17,
            "points = { t = { item = 'input:10', factor = 0.1 }, set = { item = 'holding:40:float32' } }",
            "size = 70\nvalues = { t = 21.5, set = 0.1, 'holding:0' = 8, 'holding:50:int32:swapped' = [-2, 65537], "
            "'coil:2' = [true, 0, 1], 'discrete:5' = 1 }",
        ),
        "modbus",
        {
            "t": 21.5,
            "set": pytest.approx(0.1),
            "holding:0": 8,
            "holding:50:4": (0xFFFE, 0xFFFF, 1, 1),
            "holding:52:int32:swapped": 65537,
            "coil:2:3": (True, False, True),
            "discrete:5": True,
        },
    ),
]


@pytest.mark.parametrize(("text", "kind", "wanted"), VALUES, ids=[kind for _, kind, _ in VALUES])
def test_what_the_file_says_a_node_holds_is_what_a_poll_reads_in_the_same_units(
    text: str, kind: str, wanted: dict[str, Any]
) -> None:
    assert dict(zip(wanted, values_of(text, *wanted), strict=True)) == wanted


def test_values_of_every_kind_of_node_can_be_said() -> None:
    assert {kind for _, kind, _ in VALUES} == set(kinds())


# what is wrong


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            node("msc", 1, emulated="adress_step = 4"),
            "line.toml:7: emulator.nodes.n.adress_step: no such key; did you mean 'address_step'?",
        ),
        (
            node("hcp2", 1, emulated="model = 'MSC-250'"),
            "line.toml:7: emulator.nodes.n.model: is only for nodes of msc, not of hcp2",
        ),
        (
            node("msc", 1, "model = 'MSC-25'"),
            "line.toml:5: nodes.n.model: no such model 'MSC-25'; did you mean 'MSC-250'?",
        ),
        (
            node("hcp", 1, emulated="program = 'windng'"),
            "line.toml:7: emulator.nodes.n.program: no such program 'windng'; did you mean 'winding'?",
        ),
        (node("mentor", 14, emulated="ripple = 2"), "line.toml:7: emulator.nodes.n.ripple: must be 0 to 1, not 2"),
        (node("mentor", 14, emulated="acceleration = 0"), "emulator.nodes.n.acceleration: must be above 0, not 0"),
        (node("dc104", None, emulated="read_only = [3, 'x']"), "read_only[2]: must be a whole number, 0 to"),
        (node("dc104", None, emulated="read_only = [3, true]"), "read_only[2]: must be a whole number, 0 to"),
        (node("dc104", None, emulated="eeprom = [2, 1]"), "line.toml:6: emulator.nodes.n.eeprom: a reply delay is"),
        (
            node("mentor", 14, emulated="[emulator.nodes.n.parameters]\n'7.05' = { hihg = 5 }"),
            "line.toml:8: emulator.nodes.n.parameters.7.05.hihg: no such key; did you mean 'high'?",
        ),
        (
            node("mentor", 14, emulated="[emulator.nodes.n.parameters]\n'7.06-05' = { high = 5 }"),
            "line.toml:8: emulator.nodes.n.parameters.7.06-05: the range 06-05 is descending; write 5-6",
        ),
        (
            node("hcp2", 1, emulated="[emulator.nodes.n.values]\n1 = 5\n'axis0.postion' = 1"),
            "line.toml:9: emulator.nodes.n.values.axis0.postion: an emulated controller's element 'axis0.postion'",
        ),
        (node("hcp2", 1, emulated="values = { oputs = 5 }"), "cannot be given; did you mean 'outputs'?"),
        (node("hcp2", 1, emulated="values = { 101 = 5 }"), "values.101: an emulated controller's element 101 cannot"),
        (node("hcp2", 1, emulated="values = { 1 = 'x' }"), "values.1: must be a number, true or false, or a list"),
        (node("hcp2", 1, emulated="values = { 1 = [2, nan] }"), "values.1[2]: must be a number"),
        (node("hcp", 1, emulated="values = { 99 = [1, 2] }"), "element 100 cannot be given"),
        (
            node("dc104", None, "maximum = 9", "values = { 10 = 5 }"),
            "values.10: an emulated DC104 cannot store",
        ),
        (node("dc104", None, emulated="values = { 10 = -1 }"), "parameter 10 holds a whole number, 0 to 65535, not -1"),
        (node("msc", 1, emulated="addresses = 8\nvalues = { 8 = 5 }"), "values.8: an emulated MSC cannot store"),
        (
            node("msc", 1, emulated="values = { 'flag:256' = 1 }"),
            "an emulated MSC cannot store the values at 'flag:",
        ),
        (node("msc", 1, emulated="values = { 8 = 2147483648 }"), "a data address holds a whole number, -2147483648 to"),
        (node("modbus", 1, emulated="values = { 'holding:1000' = 5 }"), "holding:1000 is beyond the 1000 addresses"),
        (node("modbus", 1, emulated="values = { 'holding:1' = 70000 }"), "holding:1 cannot hold 70000"),
        (node("modbus", 1, emulated="values = { 'holdng:1' = 7 }"), "values.holdng:1: no such item 'holdng:1'"),
        (node("mentor", 14, emulated="values = { '1.17' = 1001 }"), "1.17, without its decimals, holds a whole number"),
        (node("mentor", 14, emulated="values = { '11.11' = 1 }"), "11.11 is the drive's address: it cannot be given"),
        (node("hcp2", 1, emulated="values = { 1 = 1e300 }"), "values.1: element 1 holds -1e+09 to 1e+09, not 1e+300"),
        (node("hcp2", 1, emulated="axes = 9"), "line.toml:6: emulator.nodes.n: a controller has 1 to 8 axes"),
        (node("hcp2", 1, emulated="program = 'command_handshake'\naxes = 1"), "a controller has 2 to 8 axes"),
        (node("hcp2", 1, emulated="statement = 1e-9"), "a statement takes 0.0001 s at least"),
        (node("msc", 1, emulated="period = 1e-9"), "its program counts every 0.001 s at most"),
        (node("modbus", 1, emulated="functions = [3, 43]"), "an emulated unit knows the functions [1, 2, 3,"),
        (node("ct-ansi", 12, emulated="width = 13"), "a value has 12 characters at most, not 13"),
        (node("msc", 1, "address_step = 3"), "line.toml:2: nodes.n: no MSC is unit 1"),
        (
            node(
                "mentor",
                14,
                "points.a = { item = '1.17', decimals = 1 }\npoints.b = { item = '1.17:hires' }",
                "values = { a = 1 }",
            ),
            "line.toml:6: nodes.n.points.b: 1.17 has 1 decimals at another point",
        ),
    ],
)
def test_what_an_emulated_device_cannot_be_is_said_with_its_place_and_nearest_name(text: str, complaint: str) -> None:
    with pytest.raises(FileError) as caught:
        emulated_line(read(Source("line.toml", text)))
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(caught.value).count("line.toml") == 1


def test_a_name_that_the_file_has_is_not_guessed_where_its_value_is_refused() -> None:
    text = node("hcp2", 1, "points.speed = { item = '1' }", "values = { speed = 1e300 }")
    with pytest.raises(FileError, match=r"values\.speed: element 1 holds .*, not 1e\+300$"):
        emulated_line(read(Source("line.toml", text)))


def test_a_range_of_emulated_nodes_that_is_none_is_an_error_at_its_table() -> None:
    text = f"{node('hcp2', 1)}\n[emulator.nodes.n3-2]\nlively = true\n"
    with pytest.raises(
        FileError, match=r"line\.toml:\d+: emulator\.nodes\.n3-2: the range 3-2 is descending; write 2-3"
    ):
        read(Source("line.toml", text))


@pytest.mark.parametrize("ripple", [0, 1])
def test_a_number_can_be_each_end_of_its_range(ripple: float) -> None:
    assert device_of(node("mentor", 14, emulated=f"ripple = {ripple}")).ripple == ripple


def test_parameter_0_can_be_read_only_too() -> None:
    drive = device_of(node("dc104", None, "allow_zero = true", "read_only = [0, 3]"))
    assert isinstance(drive, EmulatedDc104)
    assert drive.read_only == {0, 3}


def test_pace_and_seed_of_a_command_go_before_those_of_the_file() -> None:
    for paced in (True, False):
        said = str(paced).lower()
        file = read(Source("line.toml", f"{node('hcp2', 5)}[emulator]\npaced = {said}\nseed = 7\n"))
        assert emulated_line(file).paced is paced
        assert emulated_line(file, paced=not paced).paced is not paced
    first = emulated_line(file, seed=8).chance.random()
    assert emulated_line(file, seed=8).chance.random() == first
    assert emulated_line(file, seed=7).chance.random() == emulated_line(file).chance.random() != first
    assert emulated_line(file, seed=0).chance.random() not in (first, emulated_line(file).chance.random())


@pytest.mark.parametrize("port", ["path = '/dev/ttyS0'", "host = '10.0.0.5'\nport = 4001\nrfc2217 = true"])
def test_an_emulated_line_has_the_framing_of_the_port(port: str) -> None:
    settings = "baudrate = 19200\nbytesize = 7\nparity = 'E'\nstopbits = 2\n"
    text = f"[port]\n{port}\n{settings}{node('hcp2', 5).removeprefix(HEAD)}"
    line = emulated_line(read(Source("line.toml", text)))
    assert line.settings == LineSettings(19200, bytesize=7, parity="E", stopbits=2)


def test_behind_a_port_of_raw_bytes_the_line_has_the_baud_rate_of_the_port_and_the_framing_of_its_protocol() -> None:
    text = f"[port]\nhost = '10.0.0.5'\nport = 4001\nbaudrate = 19200\n{node('mentor', 14).removeprefix(HEAD)}"
    for given, baudrate in ((text, 19200), (text.replace("baudrate = 19200\n", ""), 9600)):
        line = emulated_line(read(Source("line.toml", given)))
        assert line.settings == LineSettings(baudrate, bytesize=7, parity="E")
