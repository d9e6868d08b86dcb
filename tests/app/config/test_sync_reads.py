"""`probe` and `sync_reads` of a node in LINE.toml."""

from __future__ import annotations

import pytest

from busmaster.app.config.sections import LineFile, read
from busmaster.app.config.source import FileError, Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.line.configured_line import check_same_line
from busmaster.contract.profile import Profile
from busmaster.errors import InvalidCommand
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import microflex
from busmaster.protocols.modbus.codec import ReadRegisters

HEAD = 'port = "/dev/ttyUSB0?baudrate=57600"\n'
NODE = '[nodes.press]\nprotocol = "modbus"\naddress = 5\n'
DRIVES = '[nodes.drive1-2]\nprotocol = "microflex"\naddress = "1-2"\n'


def parse(text: str) -> LineFile:
    return read(Source("line.toml", HEAD + text))


def profile_of(text: str, node: str) -> Profile:
    return ConfiguredLine(parse(text), outputs=False).nodes[node].node.profile


def test_a_node_has_the_probe_and_the_sync_reads_of_its_kind_by_default() -> None:
    profile = profile_of(DRIVES, "drive1")
    assert (profile.probe, profile.sync_reads) == (microflex.PROFILE.probe, microflex.PROFILE.sync_reads)


def test_a_node_has_its_own_probe_and_sync_reads() -> None:
    text = f'{NODE}probe = "input:7"\nsync_reads = ["holding:100", "holding:100:2"]\n'
    profile = profile_of(text, "press")
    assert profile.probe == ReadRegisters(7, table="input")
    assert tuple(profile.sync_reads) == (ReadRegisters(100), ReadRegisters(100, 2))


def test_items_may_be_named_as_the_points_of_the_node() -> None:
    points = '[nodes.press.points]\nspeed = { item = "holding:40", factor = 0.1 }\n'
    assert profile_of(f'{NODE}probe = "speed"\n{points}', "press").probe == ReadRegisters(40)


def test_what_the_protocol_says_holds_for_the_nodes_that_do_not_say_otherwise() -> None:
    common = '[protocols.microflex]\nprobe = "239"\nsync_reads = ["100", "103"]\n'
    own = '[nodes.other]\nprotocol = "microflex"\naddress = 9\nprobe = "242"\n'
    line = ConfiguredLine(parse(f"{common}{DRIVES}{own}"), outputs=False)
    assert [line.nodes[name].node.profile.probe for name in ("drive1", "drive2", "other")] == [
        hcp2.Read(239),
        hcp2.Read(239),
        hcp2.Read(242),
    ]
    assert all(handle.node.profile.sync_reads == (hcp2.Read(100), hcp2.Read(103)) for handle in line.nodes.values())


@pytest.mark.parametrize(
    ("key", "complaint"),
    [
        ('probe = "holdin:7"', "line.toml:5: nodes.press.probe: no such item 'holdin:7'"),
        ("probe = 7", "line.toml:5: nodes.press.probe: must be a text"),
        ('sync_reads = ["holding:1", "x"]', "line.toml:5: nodes.press.sync_reads: no such item 'x'"),
        (
            'sync_reads = "holding:1"',
            "line.toml:5: nodes.press.sync_reads: needs at least two items, because the replies to one sync read are",
        ),
    ],
)
def test_a_wrong_item_is_an_error_at_its_key(key: str, complaint: str) -> None:
    with pytest.raises(FileError) as caught:
        profile_of(f"{NODE}{key}\n", "press")
    assert complaint in str(caught.value)


@pytest.mark.parametrize("key", ['probe = "x"', 'sync_reads = ["holding:1", "x"]'])
def test_a_wrong_item_of_a_protocol_is_an_error_at_the_node_that_does_not_have_it(key: str) -> None:
    with pytest.raises(FileError, match=r"nodes\.press: no such item 'x'") as caught:
        profile_of(f"{NODE}[protocols.modbus]\n{key}\n", "press")
    assert caught.value.line == 2


@pytest.mark.parametrize(
    "key",
    [
        'probe = "holding:1"',
        'sync_reads = ["holding:1", "holding:2"]',
        "reply_time = 0.01",
        "retries = 1",
        "timing = { window = 0.25 }",
        'timing = "learned"',
        "registers_per_read = 10",
    ],
)
def test_another_setting_of_a_node_needs_a_restart(key: str) -> None:
    with pytest.raises(InvalidCommand, match="changes of node 'press' need a restart"):
        check_same_line(parse(NODE), parse(f"{NODE}{key}\n"))
