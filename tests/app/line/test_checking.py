"""`check` finds what `run` would refuse about a file, all of it at once, and opens neither port nor outputs."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from busmaster.app.config import FileError, load
from busmaster.app.line import ConfiguredLine, check

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").glob("*.toml"))
HEAD = 'port = "/dev/nothing-is-there?baudrate=57600"\n'
NODE = '[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
GROUP = '[groups.axes]\nperiod = 0.1\npoints = ["winder/1"]\n'
GOOD = HEAD + NODE + GROUP

EVERYWHERE = """\
title = 5
port = 7
strict = "yes"
unknown = 1

[protocols.hpc2]

[nodes.press]
protocol = "msc2"
address = 1

[nodes.winder]
protocol = "mentor"
adress = 4
address = 14

[nodes.winder.points]
speed = { item = "3.02", bogus = 1, limit = 2 }
current = { item = "no-such-item" }

[groups.press]
period = 0.1
points = ["press/1", "pres*/2"]

[groups.slow]
period = 0

[groups.wrong]
period = 1
points = ["reel/1"]

[outputs.csv]
path = "no-such-folder/line.csv"
groups = ["slow"]

[outputs.cvs]
path = "line.csv"

[outputs.jsonl]
path = "same"

[outputs.sqlite]
path = "same"

[outputs.mqtt]
password_file = "no-such-password"
tls = true
ca_file = "no-such-certificates"
allow_commands = ["press/1", "reel/1"]

[safe]
writes = { "press/1" = 0, "reel/1" = 0, "winder/3.02" = "fast" }
repeatable = ["reel/2"]

[service]
share = 0.5
listen = "0.0.0.0:7420"

[service.users.no-such-user]
role = "read"

[service.users.root]
role = "owner"

[service.tokens.hmi]
role = "write"

[emulator]
paced = 1

[emulator.nodes.press]
lively = true
"""
PROBLEMS = [
    "1: title",
    "2: port",
    "3: strict",
    "4: unknown",
    "6: protocols.hpc2",
    "9: nodes.press.protocol",
    "14: nodes.winder.adress",
    "18: nodes.winder.points.speed.bogus",
    "18: nodes.winder.points.speed.limit",
    "19: nodes.winder.points.current.item",
    "26: groups.slow.period",
    "30: groups.wrong.points[1]",
    "32: outputs.csv",
    "36: outputs.cvs",
    "43: outputs.sqlite.path",
    "46: outputs.mqtt.password_file",
    "48: outputs.mqtt.ca_file",
    "52: safe.writes.reel/1",
    "53: safe.repeatable",
    "57: service.listen",
    "59: service.users.no-such-user",
    "63: service.users.root.role",
    "65: service.tokens.hmi",
    "69: emulator.paced",
]
"""What is wrong there. Nothing is reported of the node "press" but its protocol, whoever names it, nor of the commands
of an output that could not be made."""


SEVERAL = """port = "/dev/nothing-is-there?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 5
retries = -1
reply_time = "slow"
colour = 3
[groups.axes]
points = ["winder/1"]
period = 1
phase = "x"
priority = "high"
"""


def test_every_wrong_value_of_a_table_is_reported(tmp_path: Path) -> None:
    found = [f"{error.line}: {error.key}" for error in problems(tmp_path, SEVERAL)]
    assert found == [
        *("5: nodes.winder.retries", "6: nodes.winder.reply_time", "7: nodes.winder.colour"),
        *("11: groups.axes.phase", "12: groups.axes.priority"),
    ]


def test_every_wrong_write_of_a_safe_state_is_reported(tmp_path: Path) -> None:
    writes = '"winder/1" = "off"\n"winder/2" = [0, 1]\n'
    found = problems(tmp_path, f"{HEAD}{NODE}[safe.writes]\n{writes}")
    assert [error.key for error in found] == ["safe.writes.winder/1", "safe.writes.winder/2"]


def written(folder: Path, text: str) -> Path:
    path = folder / "line.toml"
    path.write_text(text)
    return path


def problems(folder: Path, text: str) -> list[FileError]:
    return list(check(written(folder, text)).problems)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_examples_have_no_problems(path: Path) -> None:
    assert check(path).problems == ()


def test_all_problems_of_all_tables_are_reported_at_once_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = problems(tmp_path, EVERYWHERE)
    assert sorted(f"{error.line}: {error.key}" for error in found) == sorted(PROBLEMS)
    assert [error.line for error in found] == sorted(error.line for error in found)


WRONG = {
    "no TOML": "port = \n",
    "no nodes": HEAD,
    "a table that is none": f'{HEAD}nodes = "all"\n',
    "a node that is no table": f"{HEAD}[nodes]\nwinder = 5\n",
    "groups that are no table": f"groups = 5\n{HEAD}{NODE}",
    "no port": NODE,
    "a port that is none": f'port = "/dev/ttyS0?baudrate=fast"\n{NODE}',
    "two nodes of one address": f'{GOOD}[nodes.other]\nprotocol = "hcp2"\naddress = 5\n',
    "a template that is not there": f'{HEAD}{NODE}template = "none.toml"\n',
    "a point that is no item": f'{GOOD}[nodes.winder.points]\nspeed = {{ item = "?" }}\n',
    "a limit of another item": f"{GOOD}[nodes.winder.points]\n1 = {{ minimum = 5, maximum = 1 }}\n",
    "a group of unknown points": f'{HEAD}{NODE}[groups.axes]\nperiod = 0.1\npoints = ["winder/none"]\n',
    "a safe state of an unknown item": f'{GOOD}[safe]\nwrites = {{ "winder/?" = 0 }}\n',
    "a repeatable write that is none": (
        f'{GOOD}[safe]\nwrites = {{ "winder/1" = 0 }}\nrepeatable = ["winder/1", "winder/2"]\n'
    ),
    "a token file that is not there": f'{GOOD}[service]\nlisten = "127.0.0.1:0"\ntoken_file = "none"\n',
    "a role for points that are none": f'{GOOD}[service.users.root]\nrole = "write"\nallow_writes = ["winder/?"]\n',
    "a password file that is not there": f'{GOOD}[outputs.mqtt]\npassword_file = "none"\n',
    "a learned file without learning": f'learned = "times"\n{GOOD}',
    "an emulated node that is none": f"{GOOD}[emulator.nodes.reel]\nlively = true\n",
}


def refuse(path: Path) -> None:
    """Do with a file what `run` does before it opens the port."""
    ConfiguredLine(file := load(path))
    file.service.secrets()


@pytest.mark.parametrize("text", WRONG.values(), ids=WRONG)
def test_the_first_problem_is_the_one_for_which_run_refuses_the_file(text: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(FileError) as refused:
        refuse(path)
    assert [str(error) for error in check(path).problems] == [str(refused.value)]


def test_what_names_a_node_with_a_problem_is_not_reported_as_unknown(tmp_path: Path) -> None:
    node = '[nodes.drive1-2]\nprotocol = "hcp2"\naddress = "3-2"\n'
    uses = '[groups.drives]\nperiod = 0.1\npoints = ["drive1-2/1", "drive2/2", "drive*/3"]\n'
    uses += '[groups.more]\nperiod = 1\npoints = "winder,drive2/1"\n'
    rest = '[safe]\nwrites = { "drive1/1" = 0 }\n[emulator.nodes.drive2]\nlively = true\n'
    rest += '[service.users.root]\nrole = "write"\nallow_writes = "drive*/1"\n'
    [error] = problems(tmp_path, HEAD + node + NODE + uses + rest)
    assert error.key == "nodes.drive1-2.address"


def test_what_names_a_point_with_a_problem_is_not_reported_as_unknown(tmp_path: Path) -> None:
    points = "[nodes.winder.points]\nspeed = { factor = 0 }\n"
    [error] = problems(tmp_path, f"{HEAD}{NODE}{points}{GROUP.replace('winder/1', 'winder/speed')}")
    assert error.key == "nodes.winder.points.speed.factor"


def test_a_node_with_a_problem_does_not_hide_that_there_is_no_protocol_of_its_name(tmp_path: Path) -> None:
    found = problems(tmp_path, f"{HEAD}{NODE}retries = -1\n[protocols.winder]\nretries = 1\n")
    assert [error.key for error in found] == ["nodes.winder.retries", "protocols.winder"]


def test_an_unknown_key_does_not_hide_the_problems_of_the_same_table(tmp_path: Path) -> None:
    found = problems(tmp_path, f'{GOOD}colour = "red"\nshape = "round"\nphase = -1\n')
    assert [error.key for error in found] == ["groups.axes.colour", "groups.axes.shape", "groups.axes.phase"]


def test_a_node_that_learns_but_has_a_problem_still_keeps_learned_times(tmp_path: Path) -> None:
    [error] = problems(tmp_path, f'learned = "times"\n{HEAD}{NODE}timing = "learned"\nretries = -1\n')
    assert error.key == "nodes.winder.retries"


def test_a_problem_in_a_template_names_the_template(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text('protocol = "hcp2"\n[points]\nspeed = { item = "1", factor = 0 }\n')
    [error] = problems(tmp_path, f'{HEAD}{NODE}template = "ours.toml"\n')
    assert (error.file, error.line) == (str(tmp_path / "ours.toml"), 3)


def test_problems_of_the_file_itself_are_before_those_of_its_templates(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text('protocol = "hcp2"\npoints.speed = { item = "1", factor = 0 }\n')
    text = f'{HEAD}{NODE}template = "ours.toml"\n{GROUP.replace("0.1", "0")}'
    found = problems(tmp_path, text)
    assert [(Path(error.file).name, error.line) for error in found] == [("line.toml", 7), ("ours.toml", 2)]


def test_a_port_without_a_baud_rate_is_no_problem_where_the_protocol_is_the_one(tmp_path: Path) -> None:
    head = 'port = "/dev/nothing-is-there"\n'
    [error] = problems(tmp_path, head + NODE.replace("hcp2", "hcp3"))
    assert error.key == "nodes.winder.protocol"


def test_a_folder_of_learned_times_that_is_not_there_is_reported_at_its_key(tmp_path: Path) -> None:
    [error] = problems(tmp_path, f'timing = "learned"\nlearned = "{tmp_path}/none/times"\n{GOOD}')
    assert (error.line, error.key) == (2, "learned")
    assert error.what.endswith(f"the folder {tmp_path}/none does not exist; create it, or use another path")


def test_two_problems_of_the_file_as_a_whole_are_both_reported(tmp_path: Path) -> None:
    found = problems(tmp_path, 'title = "Slitter"\n')
    assert [error.what.partition(";")[0] for error in found] == ["'port' is missing", "the file has no nodes"]


def test_nothing_is_opened_and_nothing_written(tmp_path: Path) -> None:
    outputs = f'[outputs.sqlite]\npath = "{tmp_path}/line.sqlite"\nspill = "{tmp_path}/spool"\n'
    path = written(tmp_path, f'{GOOD}{outputs}[outputs.csv]\npath = "{tmp_path}/line.csv"\n')
    assert check(path) == check(path)
    assert not check(path).problems
    assert list(tmp_path.iterdir()) == [path]


def test_doubts_are_warnings(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    head = 'port = "/dev/nothing-is-there?baudrate=57600&parity=O"\n'
    report = check(written(tmp_path, f'{head}{NODE}[outputs.csv]\npath = "{tmp_path}/folder"\n'))
    assert report.problems == ()
    assert [warning.partition(":")[0] for warning in report.warnings] == [
        "hcp2 is meant for 8N1, but /dev/nothing-is-there is 8O1",
        "nothing is polled, because the file has no poll group; add [groups.NAME]",
        "outputs.csv.path",
    ]


def test_a_warning_of_several_nodes_is_reported_once(tmp_path: Path) -> None:
    head = 'port = "/dev/nothing-is-there?baudrate=9600"\n'
    drives = '[nodes.drive3-5]\nprotocol = "mentor"\naddress = "3-5"\n'
    report = check(written(tmp_path, f"{head}{drives}{GROUP.replace('winder/1', 'drive3-5/1.17').replace('0.1', '1')}"))
    assert report.problems == ()
    [warning] = report.warnings
    assert warning.startswith("mentor: addresses below 10")


def test_a_schedule_that_does_not_fit_is_a_warning(tmp_path: Path) -> None:
    report = check(written(tmp_path, HEAD + NODE + GROUP.replace("0.1", "0.001")))
    assert report.problems == ()
    [warning] = report.warnings
    assert warning.startswith("cycles will be missed")


def test_what_only_the_emulator_refuses_is_a_warning(tmp_path: Path) -> None:
    report = check(written(tmp_path, f'{GOOD}[emulator.nodes.winder]\nvalues = {{ "no-such-item" = 1 }}\n'))
    assert report.problems == ()
    [warning] = report.warnings
    assert warning.startswith("`busmaster emulate` rejects the file: ")


def test_each_bad_point_of_a_node_is_reported_and_a_limit_of_the_node_hides_none(tmp_path: Path) -> None:
    points = 'a = { item = "none" }\nb = { item = "11", maximum = 5 }\nc = { factor = 0 }\nd = { minimum = "x" }\n'
    found = problems(tmp_path, f"{HEAD}{NODE}[nodes.winder.points]\n{points}{GROUP}")
    assert [error.key for error in found] == [
        f"nodes.winder.points.{key}" for key in ("a.item", "c.factor", "d.minimum")
    ]
    found = problems(tmp_path, f"{HEAD}{NODE}[nodes.winder.points]\n{points.partition('c =')[0]}{GROUP}")
    assert [error.key for error in found] == ["nodes.winder.points.a.item"]


def test_each_limit_that_cannot_be_is_reported(tmp_path: Path) -> None:
    limits = "[nodes.winder.points]\n1 = { minimum = 2, maximum = 1 }\n2 = { max_step = 0 }\n3 = { minimum = 0 }\n"
    found = problems(tmp_path, f"{HEAD}{NODE}{limits}{GROUP}")
    assert [error.key for error in found] == ["nodes.winder.points.1", "nodes.winder.points.2"]


def test_files_that_cannot_be_written_are_warnings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    year = time.strftime("%Y")
    (tmp_path / year).mkdir()
    (tmp_path / "%y").mkdir()
    text = (
        f'learned = "{tmp_path}/learned"\n{HEAD}timing = "learned"\n{NODE}{GROUP}'
        f'[outputs.csv]\npath = "{tmp_path}/%Y"\n[outputs.sqlite]\npath = "{tmp_path}/a"\nspill = "{tmp_path}/%y"\n'
    )
    path = written(tmp_path, text)
    folders = [
        f"outputs.csv.path: {tmp_path}/{year} is a folder; name a file",
        f"outputs.sqlite.spill: {tmp_path}/%y is a folder; name a file",
    ]
    assert check(path).problems == ()
    assert check(path).warnings == tuple(folders)
    asked: list[tuple[str, int]] = []

    def access(name: Path, mode: int) -> bool:
        asked.append((str(name), mode))
        return False

    monkeypatch.setattr(os, "access", access)
    why = f"{tmp_path} cannot be written by this user; check the permissions"
    assert check(path).warnings == (folders[0], f"outputs.sqlite.path: {why}", folders[1], f"learned: {why}")
    assert set(asked) == {(str(tmp_path), os.W_OK)}


def test_tokens_are_read_unless_the_service_is_disabled(tmp_path: Path) -> None:
    service = '[service]\nlisten = "127.0.0.1:7420"\ntoken_file = "/no/such/file"\n'
    [error] = problems(tmp_path, GOOD + service)
    assert error.key == "service.token_file"
    assert problems(tmp_path, f"{GOOD}{service}enabled = false\n") == []


def test_every_value_of_the_safe_state_that_is_not_one_number_is_reported(tmp_path: Path) -> None:
    values = ('"fast"', "[1, 2]", "0", "nan", "[]", "[1, inf]", "[true]")
    writes = "".join(f'"winder/{number}" = {value}\n' for number, value in enumerate(values, 1))
    found = problems(tmp_path, f'{GOOD}[safe]\nrepeatable = ["winder/3"]\n[safe.writes]\n{writes}')
    several = "must be one value; write the others as points of their own"
    number = "must be a number, true or false, or a list of them"
    assert [(error.line, error.key, error.what) for error in found] == [
        (11, "safe.writes.winder/1", f"{number}, not 'fast'"),
        (12, "safe.writes.winder/2", several),
        (14, "safe.writes.winder/4", f"{number}, not nan"),
        (15, "safe.writes.winder/5", several),
        (16, "safe.writes.winder/6[2]", f"{number}, not inf"),
        (17, "safe.writes.winder/7", "True is not a number: write 1 if that is meant"),
    ]


def test_every_problem_of_an_output_is_reported_also_if_it_is_disabled(tmp_path: Path) -> None:
    outputs = (
        '[outputs.csv]\nenabled = ENABLED\npath = "a.csv"\ngroups = ["axes", "slow", "axes"]\n'
        '[outputs.jsonl]\nenabled = ENABLED\npath = "%q.jsonl"\n'
        '[outputs.sqlite]\nenabled = ENABLED\npath = "a.db"\nbuffer = 0\n'
        '[outputs.mqtt]\nenabled = ENABLED\nhome_assistant = "homeassistant"\nmessages = "cycle"\n'
    )
    for enabled in ("true", "false"):
        found = problems(tmp_path, GOOD + outputs.replace("ENABLED", enabled))
        assert [error.key for error in found] == [
            *("outputs.csv.groups[2]", "outputs.jsonl", "outputs.sqlite.buffer", "outputs.mqtt"),
        ]


def test_each_missing_file_of_an_output_is_reported_once_with_its_key_as_by_run_unless_the_output_is_disabled(
    tmp_path: Path,
) -> None:
    missing = 'tls = true\npassword_file = "/no/such/password"\nca_file = "/no/such/ca"\n'
    mqtt = f"{GOOD}[outputs.mqtt]\n{missing}"
    path = written(tmp_path, mqtt)
    password, certificates = check(path).problems
    assert (password.key, certificates.key) == ("outputs.mqtt.password_file", "outputs.mqtt.ca_file")
    with pytest.raises(FileError) as refused:
        refuse(path)
    assert str(refused.value) == str(password)
    assert problems(tmp_path, f"{mqtt}enabled = false\n") == []


def test_a_missing_token_file_hides_no_problem_of_another_table(tmp_path: Path) -> None:
    safe = '[safe]\nwrites = { "winder/?" = 0 }\n'
    mqtt = '[outputs.mqtt]\ntls = true\npassword_file = "/no/such/password"\nca_file = "/no/such/ca"\n'
    service = '[service]\nlisten = "127.0.0.1:7420"\ntoken_file = "/no/such/tokens"\n'
    found = problems(tmp_path, f"{GOOD}{safe}{mqtt}{service}")
    assert [error.key for error in found] == [
        "safe.writes.winder/?",
        "outputs.mqtt.password_file",
        "outputs.mqtt.ca_file",
        "service.token_file",
    ]
