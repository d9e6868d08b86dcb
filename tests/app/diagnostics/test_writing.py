"""The file of what was found is one that a line can be made of, whatever the port is."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from busmaster.app.config import load
from busmaster.app.diagnostics.search import Discovery, Found
from busmaster.app.diagnostics.writing import lasting, line_text, summary
from busmaster.app.line import ConfiguredLine
from busmaster.bus.node import Node
from busmaster.contract.learning import Learned
from busmaster.contract.profile import LineSettings
from busmaster.registry import Protocol, find, protocols
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort
from tests.transport.fakes import plugged
from tests.transport.usb import UsbTree

SETTINGS = LineSettings(19200)


def node_of(protocol: Protocol, starts: tuple[float, ...] = (0.002, 0.003, 0.004)) -> Found:
    return Found(protocol.kinds[0], protocol.profile.addresses[-1], starts, 'it: says\n"this"', refuses=False)


def line_of(discovery: Discovery, port: SerialPort | TcpPort, folder: Path) -> ConfiguredLine:
    path = folder / "line.toml"
    path.write_text(line_text(port, discovery))
    return ConfiguredLine(load(path))


@pytest.mark.parametrize("protocol", protocols(), ids=lambda protocol: protocol.name)
def test_every_protocols_nodes_make_a_line(protocol: Protocol, tmp_path: Path) -> None:
    settings = (protocol.profile.line, *protocol.profile.other_lines)[-1]
    found = Discovery(settings, found=[node_of(protocol)])
    line = line_of(found, SerialPort("/dev/ttyUSB0", baudrate=9600), tmp_path)
    assert line.bus.endpoint.settings == settings
    [handle] = line.nodes.values()
    assert type(handle) is protocol.kinds[0].handle
    [group] = line.file.groups.values()
    assert group.points == (f"{next(iter(line.nodes))}/{protocol.kinds[0].probe_item}",)
    [node] = line.file.nodes.values()
    assert isinstance(node.timings, Learned) == protocol.profile.checked_requests


def test_what_was_said_of_the_port_is_kept_and_what_was_found_of_it_added(tmp_path: Path) -> None:
    said = SerialPort(
        '/dev/odd "name"',
        baudrate=9600,
        rs485=True,
        low_latency=False,
        receive_latency=0.016,
        exclusive=False,
        paced=True,
    )
    found = Discovery(LineSettings(19200, 7, "E"), echo=True, found=[node_of(find("ct-ansi").protocol)])
    port = line_of(found, said, tmp_path).bus.endpoint
    assert port == replace(said, baudrate=19200, bytesize=7, parity="E", echo=True)


@pytest.mark.parametrize(
    ("rs485", "text"),
    [
        (Rs485(by="software", delay_after=0.0004), 'rs485 = { by = "software", delay_after = 0.0004 }'),
        (Rs485(level="low", delay_before=0.002, rx_during_tx=True), 'rs485 = { level = "low", delay_before = 0.002, '),
        (Rs485(), "rs485 = {}"),
        (True, "rs485 = true"),
    ],
)
def test_rs485_is_written_as_the_file_reads_it(rs485: Rs485 | bool, text: str, tmp_path: Path) -> None:
    found = Discovery(SETTINGS, found=[node_of(find("dc104").protocol)])
    said = SerialPort("/dev/ttyS1", baudrate=19200, rs485=rs485)
    assert text in line_text(said, found)
    assert line_of(found, said, tmp_path).bus.endpoint == said


def test_a_device_servers_port_is_as_it_was_said(tmp_path: Path) -> None:
    found = Discovery(None, found=[node_of(protocols()[0])])
    said = TcpPort("::1", 4001, receive_latency=0.02)
    assert line_of(found, said, tmp_path).bus.endpoint == said


def test_an_rfc_2217_port_keeps_what_was_said_and_gets_the_settings_that_were_found(tmp_path: Path) -> None:
    found = Discovery(LineSettings(19200, 7, "E"), found=[node_of(find("ct-ansi").protocol)])
    said = Rfc2217Port("::1", 4001, baudrate=9600, dtr=False)
    port = line_of(found, said, tmp_path).bus.endpoint
    assert port == replace(said, baudrate=19200, bytesize=7, parity="E")


def test_a_slow_node_gets_a_window_that_it_can_keep(tmp_path: Path) -> None:
    hcp2 = find("hcp2").protocol
    found = Discovery(SETTINGS, found=[node_of(hcp2, (0.12, 0.13, 0.13))])
    line = line_of(found, SerialPort("/dev/ttyUSB0", baudrate=9600), tmp_path)
    [handle] = line.nodes.values()
    assert isinstance(handle.node, Node)
    assert handle.node.timings.read.window == pytest.approx(0.26)


def test_nodes_that_refuse_are_there_and_not_polled(tmp_path: Path) -> None:
    modbus = find("modbus").protocol
    found = Discovery(SETTINGS, found=[replace(node_of(modbus), refuses=True)])
    line = line_of(found, SerialPort("/dev/ttyUSB0", baudrate=9600), tmp_path)
    assert len(line.nodes) == 1
    assert not line.file.groups


def test_several_protocols_on_one_line_are_told_apart(tmp_path: Path) -> None:
    both = [find("hcp").protocol, find("hcp2").protocol]
    found = Discovery(SETTINGS, found=[replace(node_of(protocol), address=1) for protocol in both])
    line = line_of(found, SerialPort("/dev/ttyUSB0", baudrate=9600), tmp_path)
    assert list(line.nodes) == ["hcp_1", "hcp2_1"]
    assert summary(found) == ("Host Comms Protocol at 19200 8N1, node 1; Host Comms Protocol 2 at 19200 8N1, node 1")


def test_a_file_describes_each_node_with_its_reply_times_and_polls_all_that_do_not_refuse() -> None:
    hcp2 = find("hcp2").protocol
    times = {1: (0.0004, 0.0004, 0.0005), 2: (0.001, 0.0202, 0.03), 3: (0.002, 0.003, 0.004)}
    nodes = [replace(node_of(hcp2, starts), address=node, refuses=node == 3) for node, starts in times.items()]
    text = line_text(SerialPort("/dev/ttyUSB0", baudrate=9600), Discovery(SETTINGS, found=nodes))
    parsed = tomllib.loads(text)
    assert text.startswith("# What answered on /dev/ttyUSB0: Host Comms Protocol 2 at 19200 8N1, nodes 1, 2, 3.\n")
    assert [node["reply_time"] for node in parsed["nodes"].values()] == [0.001, 0.0202, 0.003]
    assert [node["address"] for node in parsed["nodes"].values()] == [1, 2, 3]
    assert not any("timing" in node for node in parsed["nodes"].values())
    assert parsed["groups"]["all"] == {"period": 0.5, "points": ["node1/1", "node2/1"]}
    assert '# its reply: it: says "this"; replies began after 1 / 20 / 30 ms (least / median / p99)' in text
    assert 'protocol = "hcp2"  # or "microflex"' in text
    assert list(parsed["port"]) == ["path", *(key for key in parsed["port"] if key != "path")]


@pytest.mark.parametrize(("slowest", "period"), [(0.01, 0.5), (0.15, 1.0), (0.2, 1.5), (0.3, 1.5)])
def test_a_cycle_of_all_nodes_has_time_to_spare(slowest: float, period: float) -> None:
    hcp2 = find("hcp2").protocol
    nodes = [replace(node_of(hcp2, (0.001, slowest)), address=node) for node in (1, 2)]
    text = line_text(SerialPort("/dev/ttyUSB0", baudrate=9600), Discovery(SETTINGS, found=nodes))
    total = 2 * (slowest + 64 * SETTINGS.byte_time)
    expected = tomllib.loads(text)["groups"]["all"]["period"]
    assert expected >= 2 * total
    assert expected == 0.5 or expected - 0.5 < 4 * total


def test_a_window_is_written_only_for_a_node_that_needs_it() -> None:
    hcp2 = find("hcp2").protocol
    window = hcp2.profile.timings.read.window
    for slowest, wanted in ((0.75 * window, None), (0.76 * window, pytest.approx(0.155))):
        found = Discovery(SETTINGS, found=[node_of(hcp2, (0.001, slowest))])
        [node] = tomllib.loads(line_text(SerialPort("/dev/ttyUSB0", baudrate=9600), found))["nodes"].values()
        assert node.get("timing", {}).get("window") == wanted


def test_a_drive_without_an_address_is_the_drive_and_unknown_settings_are_not_written() -> None:
    found = Discovery(None, found=[node_of(find("dc104").protocol)])
    assert summary(found) == f"{find('dc104').profile.title}, one drive"
    port = SerialPort("/dev/ttyUSB0", baudrate=4800)
    text = line_text(port, found)
    assert 'protocol = "dc104"\n' in text, "there is no other kind of node to name"
    parsed = tomllib.loads(text)
    assert parsed["nodes"].keys() == {"drive"}
    assert "address" not in parsed["nodes"]["drive"]
    assert parsed["port"] == {"path": "/dev/ttyUSB0", "baudrate": 4800}


def test_reply_times_are_learned_if_any_of_the_nodes_allows_it() -> None:
    both = [replace(node_of(find(name).protocol), address=1) for name in ("hcp", "hcp2")]
    for nodes, learned in ((both[:1], False), (both, True), (both[::-1], True)):
        text = line_text(SerialPort("/dev/ttyUSB0", baudrate=9600), Discovery(SETTINGS, found=nodes))
        assert ("timing" in tomllib.loads(text)) is learned


def test_a_port_that_is_not_a_usb_adapter_keeps_its_name(tmp_path: Path) -> None:
    for port in (
        SerialPort(str(tmp_path / "gone"), baudrate=9600),
        SerialPort("usb:A1", baudrate=9600),
        TcpPort("h", 1),
    ):
        assert lasting(port) is port


def test_a_usb_adapter_is_written_by_the_name_that_it_keeps(usb: UsbTree, tmp_path: Path) -> None:
    with plugged() as numbered, plugged() as unnumbered, plugged() as other:
        usb.plug(other.path, "A500XYZ", place="1-1")
        usb.plug(numbered.path, "A500ABC", place="1-2")
        usb.plug(unnumbered.path, place="1-3")
        link = tmp_path / "ttyUSB0"
        link.symlink_to(numbered.path)
        for path in (numbered.path, str(link)):
            said = SerialPort(path, baudrate=9600, echo=True)
            kept = replace(said, path="usb:A500ABC")
            assert lasting(said) == kept
            found = Discovery(SETTINGS, found=[node_of(find("dc104").protocol)])
            assert line_of(found, lasting(said), tmp_path).bus.endpoint == replace(kept, baudrate=SETTINGS.baudrate)
        without = SerialPort(unnumbered.path, baudrate=9600)
        assert lasting(without) is without, "there is no link to it that stays"
        (tmp_path / "links/by-path").mkdir(parents=True)
        (tmp_path / "links/by-path/it").symlink_to(unnumbered.path)
        assert lasting(without).name == str(tmp_path / "links/by-path/it")
