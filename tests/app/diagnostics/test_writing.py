"""The file of what was found is one that a line can be made of, whatever the port is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from busmaster.app.config import load
from busmaster.app.diagnostics.search import Discovery, Found
from busmaster.app.diagnostics.writing import line_text, summary
from busmaster.app.line import ConfiguredLine
from busmaster.bus.node import Node
from busmaster.contract.learning import Learned
from busmaster.contract.profile import LineSettings
from busmaster.registry import Protocol, find, protocols
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

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
