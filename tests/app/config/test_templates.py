"""Device templates: shipped ones say what the documents say, a node's own points override theirs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from busmaster.app.config import FileError, load
from busmaster.app.config.templates import FOLDERS, shipped, shipped_file
from busmaster.app.line import ConfiguredLine
from busmaster.contract.items import Item
from busmaster.errors import InvalidCommand
from busmaster.registry import find

HEAD = 'port = "/dev/ttyUSB0?baudrate=9600"\n[nodes.w]\nprotocol = "{kind}"\naddress = 14\n'
OURS = """\
title = "Ours"
protocol = ["hcp", "hcp2"]

[points]
speed = { item = "10", unit = "rpm", maximum = 1500 }
mode = { item = "12", labels = { 0 = "off", 1 = "run" } }
"""


def line(folder: Path, text: str, kind: str = "hcp2") -> ConfiguredLine:
    path = folder / "line.toml"
    path.write_text(HEAD.format(kind=kind) + text)
    return ConfiguredLine(load(path), outputs=False)


def named(kind: str) -> list[Item]:
    """What the document names one by one: neither ranges of numbers nor numbers, nor all flags in one go."""
    return [
        one
        for one in find(kind).documented
        if not one.item[0].isdigit() and ":" not in one.item and not re.search(r"\d-\d", one.item)
    ]


@pytest.mark.parametrize("name", shipped())
def test_a_shipped_template_says_of_every_named_item_what_the_document_says(name: str, tmp_path: Path) -> None:
    data = tomllib.loads(shipped_file(name).read_text())
    kind = data["protocol"]
    whole = line(tmp_path, f'template = "{name}"\n', kind)
    points = {whole.point(f"w/{point}").source.command: point for point in data["points"]}
    documented = {whole.nodes["w"].point(one.item).command: one for one in named(kind) if one.item != "flags"}
    assert points.keys() <= documented.keys()
    for command, point in points.items():
        one, said = documented[command], data["points"][point]
        assert point == one.item
        assert said.get("unit", "") == one.unit
        assert said.get("decimals", 0) == one.decimals
        assert said.get("bits", {}) == {bit.name: bit.number for bit in one.bits}


def test_the_templates_of_a_kind_name_every_named_item_together() -> None:
    named_there: dict[str, set[str]] = {}
    for name in shipped():
        data = tomllib.loads(shipped_file(name).read_text())
        named_there.setdefault(data["protocol"], set()).update(data["points"])
    for kind, points in named_there.items():
        assert points == {one.item for one in named(kind) if one.item != "flags"}


def test_there_are_templates_of_these_drives() -> None:
    assert shipped() == ("eurotherm-2000", "mentor-ii", "microflex", "mint", "msc", "parker-590")


def test_no_two_shipped_templates_have_one_name() -> None:
    assert len(list(FOLDERS.glob("*/*.toml"))) == len(shipped())


def test_a_template_of_ones_own_is_looked_for_beside_the_line_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ours").mkdir()
    (tmp_path / "ours" / "drive.toml").write_text(OURS)
    monkeypatch.chdir("/")
    whole = line(tmp_path, 'template = "ours/drive.toml"\n')
    assert whole.point("w/speed").unit == "rpm"
    assert whole.point("w/mode").meaning.labels == {0: "off", 1: "run"}
    assert {point.template for point in whole.file.nodes["w"].points.values()} == {"ours/drive.toml"}


def test_limits_of_a_template_hold(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(OURS)
    whole = line(tmp_path, 'template = "ours.toml"\n')
    point = whole.point("w/speed")
    assert point.encode is not None
    with pytest.raises(InvalidCommand, match="1500"):
        whole.bus.node(point.node.profile, 14).check(point.encode(1501.0))


def test_each_key_of_a_nodes_own_point_overrides_the_templates(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(OURS)
    whole = line(
        tmp_path,
        'template = "ours.toml"\n[nodes.w.points]\nspeed = { maximum = 900, precision = 1 }\nown = { item = "20" }\n',
    )
    section = whole.file.nodes["w"].points["speed"]
    assert (section.item, section.unit, section.maximum, section.meaning.precision) == ("10", "rpm", 900, 1)
    assert [(name, point.template) for name, point in whole.file.nodes["w"].points.items()] == [
        ("speed", "ours.toml"),
        ("mode", "ours.toml"),
        ("own", ""),
    ]


def test_all_nodes_of_a_range_have_the_templates_points(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(
        'port = "/dev/ttyUSB0"\n[nodes.drive4-7]\nprotocol = "microflex"\naddress = "4-7"\ntemplate = "microflex"\n'
        '[groups.all]\nperiod = 1\npoints = "drive4-7/status_word,temperature"\n'
    )
    whole = ConfiguredLine(load(path), outputs=False)
    assert [point.key for point in whole.members("all")][:6] == [
        "drive4/status_word",
        *(f"drive4/status_word.{bit}" for bit in ("ASYNCHRONOUS_ERROR", "STOP_INPUT", "HARDWARE_ENABLE", "ENABLED")),
        "drive4/temperature",
    ]


@pytest.mark.parametrize(
    ("template", "what"),
    [
        ("mentr-ii", r"line.toml:5: nodes.w.template: no such template 'mentr-ii'; did you mean 'mentor-ii'\?"),
        (
            "zzz",
            "no such template 'zzz'; use one of .*mentor-ii, .*, or the path of your own file, which ends in .toml",
        ),
        ("../mint", "no such template"),
        ("none.toml", "line.toml:5: .*none.toml cannot be read: No such file"),
        ("msc", "line.toml:5: nodes.w.template: msc is for nodes of msc, not of hcp2"),
    ],
)
def test_a_template_that_there_is_not_is_an_error_with_the_nearest(template: str, what: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=what):
        line(tmp_path, f'template = "{template}"\n')


def test_a_template_of_several_protocols_names_all_of_them_to_a_node_of_another(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(OURS)
    with pytest.raises(FileError, match=r"ours.toml is for nodes of hcp and hcp2, not of mentor; use another"):
        line(tmp_path, 'template = "ours.toml"\n', kind="mentor")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('protocol = "hcp2"\n[points]\nspeed = { unti = "V" }\n', r"ours.toml:3: points.speed.unti: .*'unit'"),
        ('protocol = "hcp2"\n[points]\nspeed = { item = "nothing" }\n', "ours.toml:3: points.speed.item: "),
        (
            'protocol = "hcp2"\n[points]\nspeed = { item = "20", bits = { A = 70 } }\n',
            "ours.toml:3: points.speed.bits: ",
        ),
        ("[points]\nspeed = {}\n", "'protocol' is missing"),
        ('protocol = "hcp3"\n', "ours.toml:1: protocol: no such protocol 'hcp3'; did you mean"),
        ('protocol = ["hcp2", "hcp3"]\n', "ours.toml:1: protocol: no such protocol 'hcp3'; did you mean"),
        ('protocol = "hcp2"\nnodes = 1\n', "ours.toml:2: nodes: no such key"),
        ('protocol = "hcp2\n', "ours.toml:1: not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_template_is_said_with_its_own_line(text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(text)
    with pytest.raises(FileError, match=what):
        line(tmp_path, 'template = "ours.toml"\n')


def test_an_error_in_a_template_is_reported_although_the_node_overrides_the_key(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text('protocol = "hcp2"\n[points]\nspeed = { item = "10", factor = 0 }\n')
    with pytest.raises(FileError, match=r"ours.toml:3: points.speed.factor: must not be 0"):
        line(tmp_path, 'template = "ours.toml"\npoints.speed = { factor = 1 }\n')


def test_a_template_that_is_a_folder_is_an_error_with_the_line_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(FileError, match=r"line.toml:5: .*folder.toml cannot be read: Is a directory"):
        line(tmp_path, 'template = "folder.toml"\n')


def test_what_does_not_go_with_the_template_is_said_with_the_nodes_line(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(OURS)
    with pytest.raises(FileError, match=r"line.toml:7: nodes.w.points.mode.*bits or labels, not both"):
        line(tmp_path, 'template = "ours.toml"\n[nodes.w.points]\nmode = { bits = { A = 0 } }\n')
