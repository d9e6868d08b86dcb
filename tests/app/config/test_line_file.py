"""What a LINE.toml may say, and what is said where it may not."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from busmaster import InvalidCommand, Priority, Rfc2217Port, Rs485, SerialPort, TcpPort
from busmaster.app.bounds import LONGEST_TITLE
from busmaster.app.config import FileError, LineFile, emulated_line, load
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.settings import FileSettings, MqttSettings, SqliteSettings
from busmaster.bus.node import Node
from busmaster.contract.learning import Learned, documented
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay
from busmaster.ext import TIMES
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc.handle import MscController
from busmaster.registry import kinds
from tests.docs.pages import ROOT, blocks

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").glob("*.toml"))
SLOW = 'port = "/dev/ttyUSB0?baudrate=9600"\n'
HEAD = 'port = "/dev/ttyUSB0?baudrate=57600"\n'
NODE = '[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
PRESS = '[nodes.press]\nprotocol = "msc"\naddress = 1\n'
SCREW = '[nodes.screw]\nprotocol = "mentor"\naddress = 14\n'


def parse(text: str) -> LineFile:
    return read(Source("line.toml", text))


def line(text: str) -> ConfiguredLine:
    return ConfiguredLine(parse(text), outputs=False)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_an_example_is_a_line_that_fits_and_can_be_emulated(path: Path) -> None:
    file = load(path)
    assert ConfiguredLine(file, outputs=False).plan().fits
    assert {device.address for device in emulated_line(file).devices} == {n.address for n in file.nodes.values()}


def test_the_examples_and_the_protocols_own_pages_show_all_protocols() -> None:
    shown = {node.protocol for path in EXAMPLES for node in load(path).nodes.values()}
    for kind in kinds().values():
        page = ROOT / "docs" / "protocols" / f"{kind.protocol.name}.md"
        shown |= {name for block in blocks(page, "toml") for name in re.findall(r'protocol = "(.+)"', block.text)}
    assert shown == set(kinds())


# ports


def test_a_serial_port_is_as_the_protocol_wants_it_unless_the_file_says_otherwise() -> None:
    assert parse(f'port = "/dev/ttyS0"\n{SCREW}').port == SerialPort(
        "/dev/ttyS0", baudrate=9600, bytesize=7, parity="E"
    )
    port = '[port]\npath = "/dev/ttyS0"\nbaudrate = 19200\necho = true\nreceive_latency = 0.001\n'
    assert parse(port + NODE).port == SerialPort("/dev/ttyS0", baudrate=19200, echo=True, receive_latency=0.001)


def test_a_usb_adapter_is_named_by_its_serial_number() -> None:
    wanted = SerialPort("usb:A500ABC", baudrate=57600)
    assert parse(f'port = "usb:A500ABC"\n{NODE}').port == wanted
    assert parse(f'[port]\npath = "usb:A500ABC"\n{NODE}').port == wanted


def test_rs485_is_true_or_false_or_a_table() -> None:
    for text, wanted in (
        ("true", True),
        ("false", False),
        ("{}", Rs485()),
        ('{ by = "software", delay_before = 0.0004 }', Rs485(by="software", delay_before=0.0004)),
        (
            '{ level = "low", delay_before = 0.001, delay_after = 0.002, rx_during_tx = true }',
            Rs485(level="low", delay_before=0.001, delay_after=0.002, rx_during_tx=True),
        ),
    ):
        port = parse(f'[port]\npath = "/dev/ttyS0"\nrs485 = {text}\n{NODE}').port
        assert port == SerialPort("/dev/ttyS0", baudrate=57600, rs485=wanted)
    dotted = '[port]\npath = "/dev/ttyS0"\nrs485.level = "low"\n'
    assert parse(dotted + NODE).port == parse(f'port = "/dev/ttyS0?rs485.level=low"\n{NODE}').port


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "1",
            "port.rs485: must be true, false or a table of by, level, delay_before, delay_after, rx_during_tx, not 1",
        ),
        ('{ level = "up" }', "port.rs485.level: no such level 'up'; there are high, low"),
        ('{ by = "hardware" }', "port.rs485.by: no such by 'hardware'; "),
        ("{ delay_before = 1 }", "port.rs485.delay_before: must be a number of seconds, 0 to 0.1, not 1"),
        ("{ delay_after = -0.001 }", "port.rs485.delay_after: must be a number of seconds, 0 to 0.1, not -0.001"),
        ("{ delay_after = 0.0004 }", "port.rs485: rs485: delay_after must be a whole number of milliseconds"),
        ("{ delay = 0.001 }", "port.rs485.delay: no such key; did you mean 'delay_"),
        ('{ rx_during_tx = "yes" }', "port.rs485.rx_during_tx: must be true or false, not 'yes'"),
        ('{ by = "software", rx_during_tx = true }', "port.rs485: rs485: rx_during_tx must be false with by"),
    ],
)
def test_a_wrong_rs485_is_named_with_its_line_its_key_and_what_is_possible(text: str, says: str) -> None:
    with pytest.raises(FileError, match=f"line.toml:3: {re.escape(says)}"):
        parse(f'[port]\npath = "/dev/ttyS0"\nrs485 = {text}\n{NODE}')


def test_a_tcp_port_is_a_url_or_a_table() -> None:
    wanted = TcpPort("10.0.0.5", 4001, baudrate=57600)
    assert parse(f'port = "socket://10.0.0.5:4001?baudrate=57600"\n{NODE}').port == wanted
    assert parse(f'[port]\nhost = "10.0.0.5"\nport = 4001\nbaudrate = 57600\n{NODE}').port == wanted


def test_an_rfc_2217_port_is_a_url_or_a_table_and_has_the_protocols_line_settings() -> None:
    wanted = Rfc2217Port("10.0.0.5", 4001, baudrate=57600)
    assert parse(f'port = "rfc2217://10.0.0.5:4001"\n{NODE}').port == wanted
    table = '[port]\nhost = "10.0.0.5"\nport = 4001\nrfc2217 = '
    assert parse(f"{table}true\n{NODE}").port == wanted
    assert parse(f"{table}false\n{NODE}").port == TcpPort("10.0.0.5", 4001)
    said = f'{table}true\nbaudrate = 9600\nparity = "E"\nstopbits = 2\ndtr = false\nrtscts = true\n'
    wanted = Rfc2217Port("10.0.0.5", 4001, baudrate=9600, parity="E", stopbits=2, dtr=False, rtscts=True)
    assert parse(f"{said}{NODE}").port == wanted


def test_protocols_that_cannot_share_a_line_are_refused_where_the_second_stands() -> None:
    with pytest.raises(FileError, match=r"line\.toml:6: nodes\.press\.protocol: msc and hcp2 nodes cannot share"):
        parse(f'port = "/dev/ttyS0"\n{NODE}{PRESS}')


def test_protocols_that_may_share_a_line_share_it() -> None:
    other = '[nodes.reel]\nprotocol = "hcp"\naddress = 5\n'
    assert list(line(f"{HEAD}{NODE}{other}").nodes) == ["winder", "reel"]


def test_a_rate_that_no_device_of_the_protocol_has_is_warned_about_once() -> None:
    feeder = PRESS.replace("press", "feeder").replace("1", "2")
    with pytest.warns(UserWarning, match="MSC nodes support only 9600 baud, not 57600") as told:
        line(f"{HEAD}{PRESS}{feeder}")
    assert len(told) == 1


# nodes and points


@pytest.mark.parametrize("addresses", ["11-13", " 11-13 "])
def test_a_range_of_names_takes_a_range_of_addresses(addresses: str) -> None:
    nodes = parse(f'{HEAD}[nodes.drive4-6]\nprotocol = "microflex"\naddress = "{addresses}"\n').nodes
    assert {name: node.address for name, node in nodes.items()} == {"drive4": 11, "drive5": 12, "drive6": 13}


def test_a_node_overrides_its_protocol_and_the_protocol_its_document() -> None:
    text = (
        f"{HEAD}[protocols.hcp2]\nretries = 1\ntiming = {{ window = 0.2 }}\n{NODE}"
        '[nodes.other]\nprotocol = "hcp2"\naddress = 6\nretries = 0\n'
        "timing = { late_after = 0.08, write = { window = 0.3, max_reply_delay = 0.4 } }\n"
    )
    nodes = parse(text).nodes
    first, second = documented(nodes["winder"].timings), documented(nodes["other"].timings)
    assert first is not None
    assert second is not None
    assert (nodes["winder"].retries, nodes["other"].retries) == (1, 0)
    assert (first.read.late_after, first.read.window, first.read.max_reply_delay) == (0.05, 0.2, 0.2)
    assert (second.read.late_after, second.read.window, second.read.max_reply_delay) == (0.08, 0.2, 0.2)
    assert (second.write.late_after, second.write.window, second.write.max_reply_delay) == (0.08, 0.3, 0.4)


@pytest.mark.parametrize(
    ("timing", "could"),
    [("", True), ("timing = { window = 0.2 }", True), ('timing = "learned"', False)],
)
def test_reply_times_could_be_learned_of_a_node_unless_they_are_also_if_it_has_times_of_its_own(
    timing: str, could: bool
) -> None:
    assert parse(HEAD + NODE + timing).nodes["winder"].could_learn is could


@pytest.mark.parametrize("step", ["read", "write", "packet"])
def test_the_reply_times_of_one_step_do_not_change_those_of_another(step: str) -> None:
    base = parse(SLOW + PRESS).nodes["press"].profile.timings
    timings = documented(parse(f"{SLOW}{PRESS}timing = {{ {step} = {{ window = 3.5 }} }}").nodes["press"].timings)
    assert timings is not None
    changed = {other for other in ("read", "write", "packet") if getattr(timings, other) != getattr(base, other)}
    assert changed == {step}
    assert getattr(timings, step).window == 3.5


def test_a_node_keeps_the_reply_times_of_writes_that_its_protocol_has_in_the_file() -> None:
    common = "[protocols.hcp2]\ntiming = { write = { window = 0.3 } }\n"
    timings = documented(parse(f"{HEAD}{common}{NODE}timing = {{ late_after = 0.01 }}\n").nodes["winder"].timings)
    assert timings is not None
    assert (timings.read.window < timings.write.window, timings.write.window) == (True, 0.3)
    assert (timings.read.late_after, timings.write.late_after) == (0.01, 0.01)


def test_a_line_has_the_name_of_its_file_unless_the_file_has_a_title() -> None:
    assert read(Source("/etc/lines/slitter.toml", HEAD + NODE)).title == "slitter.toml"
    assert read(Source("/etc/lines/slitter.toml", f'title = "Slitter 2"\n{HEAD}{NODE}')).title == "Slitter 2"


@pytest.mark.parametrize("character", ["x", "°", "張", "🏭"])
def test_a_title_has_as_many_characters_as_the_bound_whatever_bytes_they_take(character: str) -> None:
    title = character * LONGEST_TITLE
    assert parse(f'title = "{title}"\n{HEAD}{NODE}').title == title
    with pytest.raises(FileError) as caught:
        parse(f'title = "{title}{character}"\n{HEAD}{NODE}')
    bound = f"at most {LONGEST_TITLE} characters, not {LONGEST_TITLE + 1}"
    assert str(caught.value) == f"line.toml:1: title: must have {bound}"


def test_symbols_stand_for_addresses_of_thirty_two_bits() -> None:
    nodes = parse(f"{SLOW}{PRESS}symbols = {{ first = 0, last = 4294967295 }}\n").nodes
    assert nodes["press"].options["symbols"] == {"first": 0, "last": 0xFFFF_FFFF}


def test_a_file_of_symbols_may_have_any_bytes_in_its_texts_and_is_named_where_it_is_wrong(tmp_path: Path) -> None:
    listing, path = tmp_path / "press.lst", tmp_path / "line.toml"
    path.write_text(f'{SLOW}{PRESS}symbols = "press.lst"\n')
    listing.write_bytes(b" GRAD \xb0C.MAC\n DATA TABLE\n count 2008\n")
    assert load(path).nodes["press"].options["symbols"] == {"count": 2008}
    listing.write_text("DATA TABLE\ncount 2008\nb\n")
    with pytest.raises(FileError, match=rf"line.toml:5: nodes.press.symbols: {tmp_path}/press.lst: 1 line of its data"):
        load(path)
    listing.unlink()
    listing.mkdir()
    with pytest.raises(FileError, match=r"line.toml:5: nodes.press.symbols: .* cannot be read: Is a directory"):
        load(path)


def test_a_time_is_at_most_the_longest_that_the_reference_names() -> None:
    timing = "timing = {{ window = 0.1, max_reply_delay = {} }}"
    assert parse(HEAD + NODE + timing.format(10)).nodes["winder"].timings is not None
    with pytest.raises(FileError, match="max_reply_delay: must be at most 10, in seconds"):
        parse(HEAD + NODE + timing.format(10.001))


def test_reply_times_of_hcp_cannot_be_learned_because_its_requests_have_no_checksum() -> None:
    assert not parse(HEAD + NODE.replace("hcp2", "hcp")).nodes["winder"].could_learn


def test_a_node_without_a_word_on_timing_has_its_protocols() -> None:
    assert parse(HEAD + NODE).nodes["winder"].timings is None
    assert Node.of(line(HEAD + NODE).nodes["winder"]).timings == hcp2.PROFILE.timings


def test_messages_and_the_screen_call_a_node_by_its_name() -> None:
    assert line(HEAD + NODE).nodes["winder"].node.label == "winder"
    assert line(HEAD + NODE.replace("winder", "5")).nodes["5"].node.label == "node 5"


def test_a_named_point_has_its_item_its_unit_and_its_scale() -> None:
    text = f'{HEAD}{NODE}[nodes.winder.points]\nposition = {{ item = "axis0.position", unit = "mm", factor = 0.001 }}\n'
    point = line(text).point("winder/position")
    assert (point.key, point.unit, point.item) == ("winder/position", "mm", "position")
    assert point.command == hcp2.Read(100)
    assert point.decode is not None
    assert point.decode(1500.0) == 1.5
    assert not point.writable


def test_a_scaled_point_is_written_on_its_scale() -> None:
    text = f'{HEAD}{NODE}[nodes.winder.points]\nforce = {{ item = "10", factor = 0.1 }}\n'
    point = line(text).point("winder/force")
    assert point.encode is not None
    assert point.encode(12.5) == hcp2.Write(10, (125.0,))


def test_a_mentor_drives_decimals_are_its_handles_own() -> None:
    """Whose high resolution counts in tenths of them."""
    text = f'{HEAD}{SCREW}[nodes.screw.points]\nspeed = {{ item = "1.17", decimals = 1 }}\n'
    for item in ("screw/speed", "screw/1.17"):
        decode = line(text).point(item).decode
        assert decode is not None
        assert decode(-476) == -47.6


@pytest.mark.parametrize(
    ("point", "sent", "shown"),
    [
        ('{ item = "1.17", decimals = 1, factor = 2 }', "+0051", 10.2),
        ('{ item = "1.17", decimals = 1, offset = 0.5 }', "+0097", 5.6),
        ('{ item = "1.17:hires", decimals = 1, factor = 2 }', "+00510", 10.2),
        ('{ item = "1.17", factor = 0.1 }', "+0102", 5.1),
        ('{ item = "speed_reference_1" }', "+0102", 5.1),
        ('{ item = "speed_reference_1", factor = 2 }', "+0051", 10.2),
        ('{ item = "15.60", factor = 0.1 }', "00102", 5.1),
    ],
)
def test_a_scaled_value_keeps_the_decimals_that_the_drive_has(point: str, sent: str, shown: float) -> None:
    configured = line(f"{HEAD}{SCREW}points = {{ speed = {point} }}\n").point("screw/speed")
    assert configured.encode is not None
    assert str(configured.encode(10.2)).endswith(f"= {sent}")
    assert configured.value_of(51) == shown


def test_an_msc_has_its_symbols_step_and_model() -> None:
    protocol = '[protocols.msc]\naddress_step = 4\nmodel = "MSC-250"\n'
    text = f"{SLOW}{protocol}{PRESS}symbols = {{ count = 2008, a1-3 = 3000 }}\n"
    handle = line(text).nodes["press"]
    assert isinstance(handle, MscController)
    assert (handle.address_step, handle.model, handle._address_of("a1-3")) == (4, "MSC-250", 3000)


def test_a_point_of_a_group_may_be_many() -> None:
    text = (
        f'{HEAD}[nodes.drive1-2]\nprotocol = "hcp2"\naddress = "1-2"\n'
        '[groups.all]\nperiod = 1\npriority = "background"\npoints = "drive1-2,drive1/1-2,axis0.position"\n'
    )
    configured = line(text)
    assert [point.key for point in configured._wanted["all"]] == [
        *("drive1/1", "drive1/2", "drive1/axis0.position"),
        *("drive2/1", "drive2/2", "drive2/axis0.position"),
        *("drive1/1", "drive1/2", "drive1/axis0.position"),
    ]
    assert configured.file.groups["all"].priority is Priority.BACKGROUND


def test_a_name_that_looks_like_a_range_is_the_point_or_the_symbol_with_this_name() -> None:
    text = (
        f'{SLOW}{PRESS}symbols = {{ zone1-3 = 3000 }}\npoints = {{ "cam1-2" = {{ item = "2008" }} }}\n'
        '[groups.all]\nperiod = 1\npoints = "press/zone1-3,cam1-2,2012-2013,zone1-3:4,zone1-3:5-6,cam1-2"\n'
    )
    configured = line(text)
    assert [point.key for point in configured._wanted["all"]] == [
        *("press/zone1-3", "press/cam1-2", "press/2012", "press/2013"),
        *("press/zone1-3:4", "press/zone1-3:5", "press/zone1-3:6", "press/cam1-2"),
    ]
    with pytest.raises(InvalidCommand, match="no such item 'zone1'"):
        list(configured.points_named("press/zone1-2"))
    configured = line(f'{SLOW}{PRESS}symbols = {{ cam = 3000 }}\npoints = {{ "cam:1-2" = {{ item = "2008" }} }}\n')
    assert [point.source.item for point in configured.points_named("press/cam:1-2,cam:3-4")] == [
        *("2008", "cam:3", "cam:4")
    ]


def test_names_of_nodes_and_points_may_be_listed_with_spaces_and_none_may_be_missing() -> None:
    drives = f'{HEAD}[nodes.drive1-2]\nprotocol = "hcp2"\naddress = "1-2"\n{NODE}'
    found = [point.key for point in line(drives).points_named("winder , drive1-2/1 , 2")]
    assert found == ["winder/1", "winder/2", "drive1/1", "drive1/2", "drive2/1", "drive2/2"]
    for text, list_ in (("winder,,drive1/1", "winder,,drive1"), ("winder,/1", "winder,"), ("winder/1,,2", "1,,2")):
        with pytest.raises(InvalidCommand, match=f"a name is missing in '{list_}'; remove a comma, or add the name"):
            list(line(drives).points_named(text))


# outputs and the emulator


def test_only_outputs_that_are_enabled_are_there_and_all_are_checked() -> None:
    outputs = (
        '[outputs.csv]\npath = "x.csv"\n[outputs.sqlite]\npath = "x.db"\nenabled = false\n[outputs.mqtt]\nbuffer = 9\n'
    )
    found = parse(HEAD + outputs + NODE).outputs
    assert found == {"csv": FileSettings(path="x.csv"), "mqtt": MqttSettings(buffer=9)}
    with pytest.raises(FileError, match=r"line\.toml:3: outputs\.sqlite\.pth: no such key; did you mean"):
        parse(f'{HEAD}[outputs.sqlite]\npth = "x.db"\npath = "x.db"\nenabled = false\n')
    assert SqliteSettings(path="x.db").keep_days is None
    shared = '[outputs.csv]\npath = "x"\n[outputs.jsonl]\npath = "x"\nenabled = false\n'
    assert set(parse(HEAD + shared + NODE).outputs) == {"csv"}, "one that is not enabled has no file"


def test_the_emulator_has_delays_and_faults_for_all_nodes_and_for_single_ones() -> None:
    text = (
        f'{HEAD}[nodes.n1-3]\nprotocol = "hcp2"\naddress = "1-3"\n'
        "[emulator]\nreply_delay = 0.004\nfaults = { lost = 0.1 }\npaced = false\n"
        "[emulator.nodes.n2-3]\nreply_delay = [0.01, 0.02]\nfaults = { dead = 1, lost = 0 }\n"
    )
    emulated = emulated_line(parse(text))
    first, second, _ = emulated.devices
    assert (first.delay, second.delay) == (Delay(0.004), Delay(0.01, 0.02))
    assert (first.faults.lost, first.faults.dead, second.faults.lost, second.faults.dead) == (0.1, 0, 0, 1)
    assert emulated.tau == 0


def test_the_emulated_line_echoes_if_the_port_is_declared_to() -> None:
    for option, echoes in (("", False), ("&echo=0", False), ("&echo=1", True)):
        file = parse(f'port = "/dev/ttyUSB0?baudrate=57600{option}"\n{NODE}')
        assert (emulated_line(file).echo is not None) is echoes


def test_an_old_name_of_a_reply_time_is_reported_with_the_new_one() -> None:
    old, new = next(iter(TIMES.items()))
    with pytest.raises(FileError) as caught:
        parse(f"{HEAD}{NODE}timing = {{ {old} = 0.01 }}\n")
    assert f"timing.{old}: no such key; renamed to {new!r}; `busmaster migrate line.toml --write` changes" in str(
        caught.value
    )


def test_behind_a_tcp_port_the_emulated_line_is_the_protocols_at_the_ports_baud_rate() -> None:
    file = parse(f'port = "socket://127.0.0.1:1?baudrate=4800"\n{SCREW}')
    assert emulated_line(file).settings == LineSettings(4800, 7, "E")


# what is wrong


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (NODE, "line.toml: 'port' is missing"),
        (HEAD, "line.toml: the file has no nodes; define each in a table of its own, [nodes.NAME]"),
        (f"{HEAD}prot = 1", "line.toml:2: prot: no such key; did you mean 'port'?"),
        ("port = 5", "line.toml:1: port: must be a table: [port], not 5"),
        ('[port]\npath = "/dev/ttyS0"', "line.toml:1: port: 'baudrate' is missing"),
        (f"{HEAD}{NODE}points.a = {{ factor = inf }}", "nodes.winder.points.a.factor: must be finite, not inf"),
        ('port = "rfc2217://h:1"', "line.toml:1: port: rfc2217://h:1: no baud rate given"),
        ('[port]\nhost = "h"\nport = 1\nparity = "E"', "line.toml:4: port.parity: no such key"),
        ('[port]\nhost = "h"\nport = 1\nrfc2217 = true', "line.toml:1: port: 'baudrate' is missing, and the nodes' p"),
        ('[port]\nhost = "h"\nport = 1\nrfc2217 = 1', "line.toml:4: port.rfc2217: must be true or false, not 1"),
        ('[port]\npath = "/dev/ttyS0"\nbaud = 9600', "line.toml:3: port.baud: no such key; did you mean 'baudrate'?"),
        (f'[port]\npath = "/dev/ttyS0"\nparity = "Q"\n{NODE}', "line.toml:1: port: no such framing: 8Q1"),
        (f"{HEAD}[nodes.a]\naddress = 1", "line.toml:2: nodes.a: 'protocol' is missing"),
        (f"{HEAD}[nodes]\na = 5", "line.toml:3: nodes.a: must be a table: [nodes.a], not 5"),
        (
            f'{HEAD}[nodes.a]\nprotocol = "microflx"\naddress = 1',
            "line.toml:3: nodes.a.protocol: no such protocol 'microflx'; did you mean 'microflex'?",
        ),
        (f"{HEAD}{NODE}adress = 1", "line.toml:5: nodes.winder.adress: no such key; did you mean 'address'?"),
        (f'{HEAD}[nodes.a]\nprotocol = "hcp"\naddress = 16', "line.toml:4: nodes.a.address: hcp: address 16 does not"),
        (f'{HEAD}[nodes.a1-2]\nprotocol = "hcp"\naddress = "15-16"', "nodes.a1-2.address: hcp: address 16 does not"),
        (f'{HEAD}[nodes.a]\nprotocol = "hcp"\naddress = "x"', "line.toml:4: nodes.a.address: an address is a number"),
        (
            f'{HEAD}[nodes.a]\nprotocol = "mentor"\naddress = 0',
            "line.toml:4: nodes.a.address: 0 is the broadcast address",
        ),
        (f'{HEAD}[nodes.a]\nprotocol = "dc104"\naddress = 0', "line.toml:4: nodes.a.address: dc104 has no addresses"),
        (
            f'{HEAD}[nodes.a1-3]\nprotocol = "hcp"\naddress = 1',
            "line.toml:4: nodes.a1-3.address: 3 names need 3 addresses",
        ),
        (
            f'{SLOW}[nodes.a0-2]\nprotocol = "modbus"\naddress = "0-2"',
            "line.toml:4: nodes.a0-2.address: 0 is the broadcast address of modbus",
        ),
        (
            f'{HEAD}[nodes.a1-2]\nprotocol = "hcp"\naddress = "1-3"',
            "line.toml:4: nodes.a1-2.address: 2 names need 2 addresses, not 3",
        ),
        (
            f'{HEAD}[nodes.a1-2]\nprotocol = "hcp"\naddress = "1-2"\n[nodes.a2]\nprotocol = "hcp"\naddress = 3',
            "line.toml:5: nodes.a2: two nodes have the name 'a2'; rename one",
        ),
        (
            f'{HEAD}[nodes."w\\u0031"]\nprotocol = "hcp"\naddress = 1\nretries = -1',
            "line.toml:5: nodes.w1.retries: must",
        ),
        (f"{SLOW}[protocols.msc]\nsymbols = {{ a = 1 }}\n{PRESS}", "line.toml:3: protocols.msc.symbols: no such key"),
        (
            f'{HEAD}[protocols.hcp]\ntiming = "learned"\n[nodes.a]\nprotocol = "hcp"\naddress = 1',
            "line.toml:3: protocols.hcp.timing: hcp: reply windows cannot be learned",
        ),
        (
            f"{HEAD}{NODE}[safe]\nwithin = 0\nwrites = {{ 'winder/1' = 0 }}",
            "line.toml:6: safe.within: must be more than 0 and at most 60 seconds, not 0",
        ),
        (
            f"{HEAD}{NODE}[safe]\nwrites = {{ 'winder/1' = [0, 1] }}",
            "line.toml:6: safe.writes.winder/1: must be one value; write the others as points of their own",
        ),
        (f"{HEAD}{NODE}[safe]\nwrites = {{ 'winder/1' = [] }}", "line.toml:6: safe.writes.winder/1: must be one value"),
        (f"{HEAD}{NODE}[safe]\nrepeatable = ['winder/1']", "line.toml:5: safe: a safe state needs writes"),
        (f"{HEAD}[outputs.csv]\npath = 'x'\naudit = 'strict'", "line.toml:4: outputs.csv.audit: no such key"),
        (f"{HEAD}[outputs.metrics]\nbuffer = 5", "line.toml:3: outputs.metrics.buffer: no such key"),
        (
            f"{HEAD}{NODE}[outputs.csv]\npath = 'x'\nenabled = false\ngroups = ['g']",
            "line.toml:8: outputs.csv.groups[1]: no such group 'g'; there are none",
        ),
        (
            f"[port]\nhost = '10.0.0.5'\nport = 4001\npaced = true\n{NODE}",
            "line.toml:1: port: a paced TCP port needs the baud rate that it is paced by",
        ),
        ("[port]\npath = '/dev/ttyS0'\nbaudrate = 9600\n", "line.toml: the file has no nodes"),
        (
            f"{HEAD}[outputs.csv]\npath = 'x'\nsync_every = -1",
            "line.toml:4: outputs.csv.sync_every: must be 0 or more, not -1",
        ),
        (
            f'{HEAD}[nodes."a b"]\nprotocol = "hcp"\naddress = 1',
            "line.toml:2: nodes.a b: a node's name can contain letters",
        ),
        (
            f'{HEAD}{NODE}[nodes.other]\nprotocol = "microflex"\naddress = 5',
            "line.toml:7: nodes.other.address: node 'winder' already has address 5",
        ),
        (f"{HEAD}{NODE}retries = \n", "line.toml:5: not valid TOML: "),
        (f"{HEAD}[emulator]\nreply_delay = true", "line.toml:3: emulator.reply_delay: must be a number of seconds"),
        (
            f"{HEAD}[emulator.nodes.winder]\nreply_delay = [0.001, true]\n{NODE}",
            "line.toml:3: emulator.nodes.winder.reply_delay: must be a number of seconds, or two of them",
        ),
        (f"{HEAD}{NODE}symbols = {{}}", "line.toml:5: nodes.winder.symbols: is only for nodes of msc"),
        (f"{HEAD}{NODE}retries = -1", "line.toml:5: nodes.winder.retries: must be 0 to 100, not -1"),
        (
            f"{HEAD}{NODE}timing = {{ window = '1' }}",
            "nodes.winder.timing.window: must be a number of seconds, not '1'",
        ),
        (
            f"{HEAD}{NODE}[nodes.winder.timing]\nwindow = 0.2\nmax_reply_delay = 0.1",
            "line.toml:5: nodes.winder.timing: reply times must satisfy",
        ),
        (f"{HEAD}[protocols.hcp3]\nretries = 1", "line.toml:2: protocols.hcp3: no such key; did you mean 'hcp"),
        (
            f'{HEAD}{NODE}[nodes.winder.points]\nx = {{ item = "axis0.positon" }}',
            "line.toml:6: nodes.winder.points.x.item: no such item 'axis0.positon'",
        ),
        (
            f"{HEAD}{NODE}[nodes.winder.points]\nspeeed = {{ factor = 2 }}",
            "line.toml:6: nodes.winder.points.speeed: no such item 'speeed'",
        ),
        (
            f"{HEAD}{NODE}[nodes.winder.points]\n1 = {{ factor = 0 }}",
            "line.toml:6: nodes.winder.points.1.factor: must not be 0",
        ),
        (
            f'{HEAD}{NODE}[nodes.winder.points]\n"a b" = {{}}',
            "line.toml:6: nodes.winder.points.a b: the name 'a b' contains a space",
        ),
        (
            f'{HEAD}{SCREW}[nodes.screw.points]\na = {{ item = "1.17", decimals = 1 }}\nb = {{ item = "1.17:hires" }}',
            "line.toml:7: nodes.screw.points.b: 1.17 has 1 decimals at another point",
        ),
        (f"{HEAD}[groups.g]\npoints = []", "line.toml:2: groups.g: 'period' is missing: a number of seconds"),
        (f"{HEAD}[groups.g]\nperiod = true\npoints = []", "groups.g.period: must be a number of seconds, not true"),
        (f"{HEAD}[groups.g]\nperiod = 1\npoints = [\n'a/1', 2]", "line.toml:5: groups.g.points[2]: must be a text"),
        (f"{HEAD}[groups.g]\nperiod = 1\npriority = 'high'\npoints = []", "no such priority 'high'; there are poll, b"),
        (
            f"{HEAD}[groups.g]\npoints = []\nperiod = 0",
            "line.toml:4: groups.g.period: poll group 'g': a period is 0.001 to 86400 s, not 0",
        ),
        (
            f"{HEAD}[groups.g]\nperiod = 1\nphase = 1\npoints = []",
            "line.toml:4: groups.g.phase: poll group 'g': a phase",
        ),
        (
            f"{HEAD}{NODE}[groups.g]\nperiod = 1\npoints = [\n'winder/1',\n'wider/1']",
            "line.toml:9: groups.g.points[2]: no such node 'wider'; did you mean 'winder'?",
        ),
        (f"{HEAD}{NODE}[groups.g]\nperiod = 1\npoints = ['winder']", "'winder' is not a point; write NODE/ITEM"),
        (f"{HEAD}{NODE}[groups.g]\nperiod = 1\npoints = ['winder/1,']", "a name is missing in '1,'"),
        (
            f"{HEAD}{NODE}[groups.g]\nperiod = 1\npoints = ['winder/axis0.postion']",
            "line.toml:7: groups.g.points[1]: no such item 'axis0.postion'",
        ),
        (
            f"{SLOW}{PRESS}address_step = 4\n[groups.g]\nperiod = 1\npoints = ['press/2000:33']",
            "line.toml:8: groups.g.points[1]: a point that is polled has at most 32 values",
        ),
        *(
            (
                f"{HEAD}[outputs.sqlite]\npath = 'x'\n{key} = 0",
                f"line.toml:4: outputs.sqlite.{key}: must be more than 0, not 0; leave it out to keep all",
            )
            for key in ("keep_days", "keep_mb")
        ),
        (f"{HEAD}[outputs.sqlit]\npath = 'x'", "line.toml:2: outputs.sqlit: no such key; did you mean 'sqlite'?"),
        (f"{HEAD}[outputs.csv]\npath = 'x'\ngroups = ['g']", "line.toml:4: outputs.csv.groups[1]: no such group 'g'"),
        (
            f"{HEAD}{NODE}[groups.g]\nperiod = 1\npoints = 'winder/1'\n[outputs.csv]\npath = 'x'\ngroups = ['g', 'h']",
            "line.toml:10: outputs.csv.groups[2]: no such group 'h'",
        ),
        (
            f"{HEAD}[outputs.csv]\npath = 'x'\nspill = 'x'",
            "line.toml:4: outputs.csv.spill: is already the file of csv.path; use another path",
        ),
        (
            f"{HEAD}[outputs.csv]\npath = 'x'\n[outputs.jsonl]\nspill = 'y'\npath = 'x'",
            "line.toml:6: outputs.jsonl.path: is already the file of csv.path; use another path",
        ),
        (
            f"{HEAD}[outputs.csv]\npath = 'x'\nspill = 'z'\n[outputs.mqtt]\nspill = 'z'",
            "line.toml:6: outputs.mqtt.spill: is already the file of csv.spill; use another path",
        ),
        (
            f"{HEAD}[outputs.csv]\npath = 'x'\n[outputs.sqlite]\npath = 'y'\nspill = 'x'",
            "line.toml:6: outputs.sqlite.spill: is already the file of csv.path; use another path",
        ),
        (
            f"{HEAD}{NODE}[groups.g]\nperiod = 1\npoints = ['winder/1,', 'winder/2']",
            "line.toml:7: groups.g.points[1]: a name is missing in '1,'",
        ),
        (f"{HEAD}[outputs.csv]\npath = 'x'\nbuffer = 0", "line.toml:4: outputs.csv.buffer: must be 1 to"),
        (f"{HEAD}[outputs.mqtt]\nprefix = 'a/#'", "line.toml:3: outputs.mqtt.prefix: a topic must not contain"),
        (f"{HEAD}[outputs.mqtt]\nqos = 2", "line.toml:3: outputs.mqtt.qos: must be 0 to 1, not 2"),
        (
            f"{HEAD}[emulator.faults]\nlosst = 1",
            "line.toml:3: emulator.faults.losst: no such key; did you mean 'lost'?",
        ),
        (f"{HEAD}{NODE}[emulator.faults]\nlost = 2", "line.toml:6: emulator.faults.lost: fault lost is a probability"),
        (f"{HEAD}[emulator]\nreply_delay = [2, 1]", "line.toml:3: emulator.reply_delay: a reply delay is"),
        (
            f"{HEAD}[emulator]\nreply_delay = []",
            "line.toml:3: emulator.reply_delay: must be a number of seconds, or two",
        ),
        (f"{HEAD}[emulator]\nreply_delay = 'x'", "line.toml:3: emulator.reply_delay: must be a number of seconds"),
        (
            f"{HEAD}{NODE}[emulator.nodes.widner]",
            "line.toml:5: emulator.nodes.widner: no such node 'widner'; did you mean",
        ),
    ],
)
def test_an_error_names_file_line_and_key_and_what_would_do(text: str, complaint: str) -> None:
    with pytest.raises(FileError) as caught:
        line(text)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("other", ["./x", "a/../x", ".//x", "HERE/x", "link/x"])
def test_the_file_of_an_output_is_the_same_however_its_path_is_written(
    other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path)
    other = other.replace("HERE", str(tmp_path))
    outputs = f'[outputs.csv]\npath = "x"\n[outputs.jsonl]\npath = "y"\nspill = "{other}"\n'
    with pytest.raises(FileError, match=r"line\.toml:9: outputs\.jsonl\.spill: is already the file of csv\.path"):
        parse(HEAD + NODE + outputs)
    assert set(parse(HEAD + NODE + outputs.replace(other, f"{other}.spill")).outputs) == {"csv", "jsonl"}


def test_what_an_output_cannot_do_is_said_where_the_file_asks_for_it(tmp_path: Path) -> None:
    text = f'{HEAD}{NODE}[outputs.csv]\npath = "{tmp_path}/none/x.csv"\n'
    with pytest.raises(FileError, match=r"line\.toml:5: outputs\.csv: .*the folder .* does not exist; create it"):
        ConfiguredLine(parse(text))


def test_each_group_of_an_output_must_be_one_that_it_can_take() -> None:
    nodes = f'{SLOW}{PRESS}points.run = {{ item = "2000:4" }}\n'
    groups = "".join(
        f"[groups.{name}]\nperiod = 1\npoints = 'press/{item}'\n" for name, item in (("a", 1), ("b", "run"))
    )
    with pytest.raises(FileError, match=r"outputs\.metrics\.groups: cannot take press/run: it is a run"):
        ConfiguredLine(parse(f"{nodes}{groups}[outputs.metrics]\ngroups = ['a', 'b']\n"))
    ConfiguredLine(parse(f"{nodes}{groups}[outputs.metrics]\ngroups = 'a'\n"))


def test_an_option_of_a_node_overrides_that_of_its_protocol() -> None:
    press = PRESS.replace("nodes.press", "nodes.other").replace("address = 1", "address = 2")
    common = "[protocols.msc]\naddress_step = 4\n"
    nodes = parse(f"{SLOW}{common}{PRESS}address_step = 2\n{press}").nodes
    assert [node.options["address_step"] for node in nodes.values()] == [2, 4]


def test_a_command_may_only_be_allowed_for_what_can_be_written() -> None:
    text = f'{HEAD}{NODE}[outputs.mqtt]\nallow_commands = ["winder/1", "winder/axis0.position"]\n'
    with pytest.raises(FileError, match=r"line\.toml:6: outputs\.mqtt\.allow_commands\[2\]: .* is read-only"):
        ConfiguredLine(parse(text))


def test_a_line_whose_windows_are_learned_keeps_the_documents_for_hcp() -> None:
    text = 'port = "/dev/ttyS0"\ntiming = "learned"\n'
    nodes = '[nodes.a]\nprotocol = "hcp"\naddress = 1\n[nodes.b]\nprotocol = "hcp2"\naddress = 2\n'
    file = parse(text + nodes)
    assert file.nodes["a"].timings is None
    assert isinstance(file.nodes["b"].timings, Learned)


def test_windows_of_a_node_of_hcp_cannot_be_learned_and_the_file_says_where() -> None:
    text = 'port = "/dev/ttyS0"\n[nodes.a]\nprotocol = "hcp"\naddress = 1\ntiming = "learned"\n'
    with pytest.raises(FileError, match=r"line\.toml:5: nodes\.a\.timing: hcp: reply windows cannot be learned"):
        parse(text)


@pytest.mark.parametrize(
    ("line", "protocol", "node", "learned"),
    [
        ("", "", "", False),
        ('timing = "learned"\n', "", "", True),
        ("", '[protocols.hcp2]\ntiming = "learned"\n', "", True),
        ("", "", 'timing = "learned"\n', True),
        ('timing = "learned"\n', "", "timing = { learned = false }\n", False),
        ("", "", "timing = { learned = true, window = 0.2 }\n", True),
    ],
)
def test_reply_times_are_learned_where_the_line_its_protocol_or_the_node_says_so(
    line: str, protocol: str, node: str, learned: bool
) -> None:
    text = f'{line}port = "/dev/null"\n{protocol}[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n{node}'
    timings = parse(text).nodes["winder"].timings
    assert isinstance(timings, Learned) == learned
    document = documented(timings)
    if "window" in node:
        assert document is not None
        assert document.read.window == 0.2


def test_a_timing_that_is_neither_a_table_nor_learned_is_refused() -> None:
    with pytest.raises(FileError, match="timing"):
        parse('port = "/dev/null"\n[nodes.winder]\nprotocol = "hcp2"\naddress = 5\ntiming = "fast"\n')
