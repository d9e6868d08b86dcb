"""`[service]` in LINE.toml: who may come, who may do what, and what is refused as it is read."""

from __future__ import annotations

import asyncio
import grp
import os
import pwd
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.bounds import SHORTEST_TOKEN
from busmaster.app.config import FileError, LineFile
from busmaster.app.config.sections import read
from busmaster.app.config.service import read_tokens
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine, configured_line
from busmaster.app.service.permission import Access, Permission, digest_of
from busmaster.app.service.rights import Role
from busmaster.contract.bounds import LONGEST_FILE
from busmaster.errors import InvalidCommand

USER, GROUP = pwd.getpwuid(0).pw_name, grp.getgrgid(0).gr_name
TEXT = """
port = "/dev/ttyUSB0?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 5
points.force = { item = "10", unit = "N" }
points.force_fine = { item = "10", unit = "mN", factor = 1000 }
[nodes."drive1-3"]
protocol = "hcp2"
address = "11-13"
points.speed = { item = "20" }
points.weight = { item = "21", writable = false }
[nodes.press]
protocol = "hcp"
address = 1
"""
HMI = "hmi   a-token-of-the-hmi-0001\n"


def parse(text: str) -> LineFile:
    return read(Source("line.toml", text))


def role(said: str, text: str = TEXT) -> Permission:
    """What this user may do, of whom the file says so much."""
    file = parse(f'{text}[service.users.{USER}]\nrole = "write"\n{said}\n')
    return ConfiguredLine(file, outputs=False).authorisation.access.users[0]


def only(*names: str) -> Any:
    return role(f"allow_writes = {list(names)!r}").only


def test_a_role_is_of_a_user_a_group_or_a_token(tmp_path: Path) -> None:
    (tmp_path / "tokens").write_text(HMI)
    (tmp_path / "tokens").chmod(0o600)
    file = parse(f"""{TEXT}[service]
group = "{GROUP}"
listen = "0.0.0.0:7420"
token_file = "{tmp_path}/tokens"
users.{USER}.role = "read"
groups.{GROUP}.role = "write"
tokens.hmi = {{ role = "write", allow_writes = "winder/force" }}
""")
    access = ConfiguredLine(file, outputs=False).authorisation.access
    assert access.users == {0: Permission(f"user {USER}", Role.READ)}
    assert access.groups == {0: Permission(f"group {GROUP}", Role.WRITE)}
    assert access.tokens == {"hmi": Permission("token hmi", Role.WRITE, {("hcp2", 5): frozenset({10})})}
    assert access.secrets == {}  # until the line is served
    assert file.service.listen == ("0.0.0.0", 7420)
    assert file.service.secrets() == {"hmi": digest_of("a-token-of-the-hmi-0001")}


@pytest.mark.parametrize(
    ("said", "mode"), [("", 0o600), (f'group = "{GROUP}"', 0o660), (f'group = "{GROUP}"\nmode = "0640"', 0o640)]
)
def test_socket_is_open_to_its_group_unless_the_file_has_another_mode(said: str, mode: int) -> None:
    assert parse(f"{TEXT}[service]\n{said}\n").service.mode == mode


def test_what_may_be_written_is_a_quantity_whatever_names_it() -> None:
    assert only("winder/force") == only("winder/force_fine") == only("winder/10") == {("hcp2", 5): frozenset({10})}


def test_points_are_named_as_in_a_group_or_by_a_pattern_of_nodes() -> None:
    speeds = {("hcp2", number): frozenset({20}) for number in (11, 12, 13)}
    assert only("drive1-3/speed") == only("drive*/speed") == speeds
    assert only("drive1/speed,22", "drive1/23") == {("hcp2", 11): frozenset({20, 22, 23})}
    assert only("drive1/speed", "drive1/*", "drive1/22") == {("hcp2", 11): None}
    assert set(only("*/*")) == {("hcp2", 5), *speeds, ("hcp", 1)}
    assert role("").only is None


def test_of_a_run_each_value_may_be_written() -> None:
    text = 'port = "/dev/ttyUSB0"\n[nodes.press]\nprotocol = "modbus"\naddress = 1\n'
    places = role('allow_writes = "press/holding:40:3"', text).only
    assert places == role('allow_writes = "press/holding:40-42"', text).only
    assert [len(allowed or ()) for allowed in (places or {}).values()] == [3]


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        ('allow_writes = "winder/nothing"', r"users\.\w+\.allow_writes\[1\]: no such item 'nothing'"),
        ('allow_writes = ["winder/force", "drive*/weight"]', r"allow_writes\[2\]: drive1/weight is read-only"),
        ('allow_writes = "reel*/speed"', "no node matches 'reel*'; the nodes are winder, drive1"),
        ('allow_writes = "*"', r"'\*' is not a point; write NODE/ITEM"),
        ("allow_writes = []", "leave it out to permit the whole line"),
        ('allow_reads = "winder/force"', "no such key; did you mean 'allow_writes'"),
    ],
)
def test_what_is_no_point_that_could_be_written_is_refused_with_its_place(said: str, complaint: str) -> None:
    with pytest.raises(FileError, match=complaint.replace("reel*", r"reel\*")) as refused:
        role(said)
    assert str(refused.value).startswith("line.toml:")


def test_what_cannot_be_permitted_alone_is_refused_with_the_node_that_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    class Nothing:
        """No command is placed."""

    monkeypatch.setattr(configured_line, "Placed", Nothing)
    with pytest.raises(FileError, match=r"drive1/speed cannot be permitted alone; permit drive1/\*$"):
        role('allow_writes = "drive*/speed"')
    assert only("drive1/*") == {("hcp2", 11): None}


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        ('listen = "0.0.0.0:7420"', "service.listen: 0.0.0.0 is reachable from the network; give each program a token"),
        ('listen = "plc"', "service.listen: a TCP address is written HOST:PORT"),
        ('token_file = "tokens"', "service.token_file: tokens need TCP; add an address"),
        ('tokens.hmi.role = "read"', "service.tokens.hmi: tokens are stored in a separate file"),
        ('users.nobody-at-all.role = "read"', "the user 'nobody-at-all' does not exist on this machine"),
        ('groups.nobody-at-all.role = "read"', "the group 'nobody-at-all' does not exist on this machine"),
        (f'groups.{GROUP}.role = "read"', "groups cannot open a socket of mode 0600; set group = "),
        (f'users.{USER}.role = "owner"', "no such role 'owner'; there are read, write, admin"),
        (f"users.{USER} = {{}}", "'role' is missing"),
        (
            f'users.{USER} = {{ role = "read", allow_writes = "winder/force" }}',
            'needs role = "write" or',
        ),
    ],
)
def test_what_is_wrong_in_the_section_is_refused_with_its_place(said: str, complaint: str) -> None:
    with pytest.raises(FileError, match=complaint):
        parse(f"{TEXT}[service]\n{said}\n")


@pytest.mark.parametrize("mode", ["0606", "0660"])
def test_a_group_can_have_a_role_if_it_can_open_the_socket(mode: str) -> None:
    section = parse(f'{TEXT}[service]\nmode = "{mode}"\ngroups.{GROUP}.role = "read"\n').service
    assert [role.role for role in section.groups.values()] == [Role.READ]


def tokens(folder: Path, text: str, mode: int = 0o600, roles: str = "") -> dict[str, bytes]:
    path = folder / "tokens"
    path.write_text(text)
    path.chmod(mode)
    said = f'listen = "127.0.0.1:7420"\ntoken_file = "{path}"\n{roles}'
    return parse(f"{TEXT}[service]\n{said}\n").service.secrets()


def test_a_file_of_tokens_has_a_name_and_a_token_a_line(tmp_path: Path) -> None:
    found = tokens(tmp_path, f"# of the plant\n\n{HMI}  # of the office\nlogger\tanother-token-0002\n")
    assert found == {"hmi": digest_of("a-token-of-the-hmi-0001"), "logger": digest_of("another-token-0002")}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("hmi secret\n", "tokens:1: the token of hmi has less than 16 characters; make one with openssl rand -hex 32"),
        (f"{HMI}hmi another-token-0002\n", "tokens:2: two tokens have the name 'hmi'"),
        ("a-token-of-the-hmi-0001\n", "tokens:1: expected a name and its token"),
        ("hmi = a-token-of-the-hmi-0001\n", "tokens:1: expected a name and its token"),
        ("# none yet\n", "has no tokens"),
    ],
)
def test_a_file_that_is_no_list_of_tokens_is_refused_and_no_token_told(
    tmp_path: Path, text: str, complaint: str
) -> None:
    with pytest.raises(FileError, match=complaint) as refused:
        tokens(tmp_path, text)
    assert str(refused.value).startswith("line.toml:")
    assert "a-token" not in str(refused.value)
    assert "another" not in str(refused.value)


@pytest.mark.parametrize("mode", [0o604, 0o644, 0o660, 0o602])
def test_tokens_that_others_may_read_or_change_are_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(FileError, match=r"service\.token_file: other users can read or change .*; run chmod 600"):
        tokens(tmp_path, HMI, mode)
    assert tokens(tmp_path, HMI, 0o640)


def test_tokens_can_be_those_of_root_and_not_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def owned_by(user: int) -> Callable[[int], Any]:
        def found(descriptor: int) -> Any:
            status = fstat(descriptor)
            return SimpleNamespace(st_mode=status.st_mode, st_size=status.st_size, st_uid=user)

        return found

    fstat = os.fstat
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    for user in (0, 1000):
        monkeypatch.setattr(os, "fstat", owned_by(user))
        assert list(tokens(tmp_path, HMI)) == ["hmi"]
    monkeypatch.setattr(os, "fstat", owned_by(1001))
    with pytest.raises(FileError, match=r"other users can read or change .*; run chmod 600 .* as its owner"):
        tokens(tmp_path, HMI)


def test_a_token_has_as_many_characters_as_the_bound(tmp_path: Path) -> None:
    assert list(tokens(tmp_path, f"hmi {SHORTEST_TOKEN * 'x'}\n")) == ["hmi"]
    with pytest.raises(FileError, match=f"less than {SHORTEST_TOKEN} characters"):
        tokens(tmp_path, f"hmi {(SHORTEST_TOKEN - 1) * 'x'}\n")


def test_a_file_of_tokens_is_bounded_and_a_text(tmp_path: Path) -> None:
    path = tmp_path / "large"
    path.write_text(HMI + (LONGEST_FILE - len(HMI)) * "#")
    path.chmod(0o600)
    assert list(read_tokens(str(path))) == ["hmi"]
    os.truncate(path, LONGEST_FILE + 1)
    with pytest.raises(InvalidCommand, match=f"large has more than {LONGEST_FILE} bytes; it is not a list of tokens"):
        read_tokens(str(path))
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidCommand, match="large is not a text file; write a name and its token on each line"):
        read_tokens(str(path))


def test_each_user_group_and_token_has_its_own_role() -> None:
    names = {
        kind: [USER if kind == "users" else GROUP, "nobody" if kind == "users" else "daemon"]
        for kind in ("users", "groups")
    }
    roles = "".join(
        f'[service.{kind}.{name}]\nrole = "{role}"\n'
        for kind, both in names.items()
        for name, role in zip(both, ("read", "write"), strict=True)
    )
    service = '[service]\nmode = "0660"\nlisten = "127.0.0.1:7420"\ntoken_file = "/none"\n'
    both = 'tokens.one.role = "read"\ntokens.two.role = "write"\n'
    access = ConfiguredLine(parse(f"{TEXT}{service}{both}{roles}"), outputs=False).authorisation.access
    for found, kind in ((access.users, "user"), (access.groups, "group"), (access.tokens, "token")):
        assert [each.role for each in found.values()] == [Role.READ, Role.WRITE]
        assert all(each.who.startswith(f"{kind} ") for each in found.values())
    assert list(access.users) == [0, pwd.getpwnam("nobody").pw_uid]
    assert list(access.groups) == [0, grp.getgrnam("daemon").gr_gid]
    assert list(access.tokens) == ["one", "two"]


def test_a_token_of_which_the_section_speaks_has_to_be_in_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"service\.tokens\.hmy: there is no token 'hmy' in "):
        tokens(tmp_path, HMI, roles='tokens.hmy.role = "write"')
    with pytest.raises(FileError, match=r"service\.tokens\.logger: there is no token 'logger' in "):
        tokens(tmp_path, HMI, roles='tokens.hmi.role = "write"\ntokens.logger.role = "read"')
    with pytest.raises(FileError, match="cannot be read: No such file"):
        parse(f'{TEXT}[service]\nlisten = "[::1]:7420"\ntoken_file = "{tmp_path}/none"\n').service.secrets()
    with pytest.raises(FileError, match="it is a FIFO, a socket or a device"):
        parse(f'{TEXT}[service]\nlisten = "[::1]:7420"\ntoken_file = "/dev/null"\n').service.secrets()
    os.mkfifo(tmp_path / "fifo")  # without a writer, a plain open would block
    with pytest.raises(FileError, match="it is a FIFO, a socket or a device"):
        parse(f'{TEXT}[service]\nlisten = "[::1]:7420"\ntoken_file = "{tmp_path}/fifo"\n').service.secrets()


def test_other_roles_are_taken_by_a_line_that_runs_and_another_port_is_not() -> None:
    line = ConfiguredLine(parse(f'{TEXT}[service.users.{USER}]\nrole = "read"\n'), outputs=False)

    def access() -> Access:
        return line.authorisation.access

    async def run() -> None:
        with pytest.raises(InvalidCommand, match=r"changes of \[service\] need a restart"):
            await line.take(parse(f'{TEXT}[service]\nlisten = "127.0.0.1:7420"\n'))
        line.authorisation.take_secrets({"hmi": b"kept"})
        line.authorisation.on_access.append(lambda: told.append((access().users[0].writes, dict(access().secrets))))
        await line.take(parse(f'{TEXT}[service.users.{USER}]\nrole = "write"\n'))
        await line.take(parse(f'{TEXT}[service.users.{USER}]\nrole = "read"\n'), {"view": b"new"})
        await line.take(parse(f'{TEXT}[service.users.{USER}]\nrole = "read"\n'), {})

    told: list[tuple[bool, dict[str, bytes]]] = []
    asyncio.run(run())
    assert told == [(True, {"hmi": b"kept"}), (False, {"view": b"new"}), (False, {})]


def test_the_share_of_line_time_that_each_program_has() -> None:
    assert parse(TEXT).service.share == 1.0
    for share in (0.1, 0.5, 10.0):  # as docs/service.md says
        assert parse(f"{TEXT}[service]\nshare = {share}\n").service.share == share
