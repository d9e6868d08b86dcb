"""Which lines are found in the folders of sockets, and what a socket leaves behind."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import stat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.service import folder as folders
from busmaster.app.service.folder import (
    LONGEST_LINE_NAME,
    LONGEST_PATH,
    Owner,
    ServedSocket,
    checked_name,
    find_owner,
    line_name,
    owners,
    plain_address,
    runtime_folder,
    socket_path,
)
from busmaster.errors import InvalidCommand, LineDown


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this user, and none of systemd's."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(folders, "SYSTEM", tmp_path / "system")
    return runtime_folder()


def served(path: Path, port: str = "/dev/ttyUSB0", name: str = "") -> ServedSocket:
    return ServedSocket(Owner(name or path.stem, port, str(path), os.getpid()))


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.parametrize(
    ("port", "name"),
    [
        ("/dev/serial/by-id/", "by-id"),
        ("///", "line"),
        (".slitter-.", "slitter"),
        ("x" * 80, "x" * LONGEST_LINE_NAME),
    ],
)
def test_the_name_of_a_line_has_no_edges_and_a_limited_length(port: str, name: str) -> None:
    assert line_name(port) == name
    assert checked_name(name) == name


# the folder


def test_a_folder_that_cannot_be_made_is_reported_with_the_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with pytest.raises(InvalidCommand, match="busmaster cannot be made: Not a directory; set XDG_RUNTIME_DIR"):
        runtime_folder()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    with pytest.raises(InvalidCommand, match="cannot be made: No such file or directory"):
        runtime_folder()
    assert list(owners()) == []


def test_the_folder_of_systemd_goes_before_the_users_and_each_user_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/busmaster/slitter:/run/other")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert folders._folder() == Path("/run/busmaster/slitter")
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    assert folders._folder() == Path("/run/user/7/busmaster")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert folders._folder() == Path(f"/tmp/busmaster-{os.getuid()}")


@pytest.mark.parametrize(
    ("mode", "user", "right"),
    [
        (stat.S_IFDIR | 0o700, 1000, True),
        (stat.S_IFDIR | 0o755, 0, True),
        (stat.S_IFDIR | 0o700, 1001, False),
        (stat.S_IFDIR | 0o770, 1000, False),
        (stat.S_IFDIR | 0o702, 1000, False),
        (stat.S_IFREG | 0o700, 1000, False),
    ],
)
def test_a_folder_is_used_if_only_this_user_or_root_may_write_there(
    monkeypatch: pytest.MonkeyPatch, mode: int, user: int, right: bool
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    found: Any = SimpleNamespace(lstat=lambda: SimpleNamespace(st_mode=mode, st_uid=user))
    assert folders._is_ours(found) is right


def test_a_link_to_a_folder_is_not_used_and_its_lines_are_not_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(folders, "SYSTEM", tmp_path / "system")
    (tmp_path / "theirs").mkdir(mode=0o700)
    (tmp_path / "busmaster").symlink_to(tmp_path / "theirs")
    with served(tmp_path / "theirs" / "slitter.sock"):
        assert list(owners()) == []
    with pytest.raises(InvalidCommand, match="others may write in"):
        runtime_folder()


def test_lines_of_systemd_are_found_each_once(folder: Path, tmp_path: Path) -> None:
    system = tmp_path / "system"
    (system / "winder").mkdir(parents=True)
    (system / "notes").touch()
    with served(folder / "own.sock"), served(system / "press.sock"), served(system / "winder" / "winder.sock"):
        (system / "own.line").write_text((folder / "own.line").read_text())  # a second entry for the same socket
        assert [owner.name for owner in owners()] == ["own", "press", "winder"]
        assert socket_path("winder") == str(system / "winder" / "winder.sock")


@pytest.mark.parametrize(
    "entry",
    [
        b"",
        b"[]",
        b"[" * 3000,
        b"\xff",
        b'{"name": "a", "port": "p", "socket": "SOCKET"}',
        b'{"name": "a", "port": "p", "socket": "SOCKET", "pid": 1, "colour": "red"}',
        b'{"name": 1, "port": "p", "socket": "SOCKET", "pid": 1}',
        b'{"name": "a", "port": null, "socket": "SOCKET", "pid": 1}',
        b'{"name": "a", "port": "p", "socket": "SOCKET", "pid": "1"}',
        b'{"name": "a", "port": "p", "socket": "SOCKET", "pid": true}',
        b'{"name": "a", "port": "p\\u0000", "socket": "SOCKET", "pid": 1}',
        b'{"name": "a", "port": "p", "socket": "SOCKET\\u0000", "pid": 1}',
    ],
    ids=range(12),
)
def test_an_entry_that_is_not_an_owners_is_ignored(folder: Path, entry: bytes) -> None:
    with served(folder / "own.sock"):
        (folder / "another.line").write_bytes(entry.replace(b"SOCKET", os.fsencode(folder / "own.sock")))
        (folder / "folder.line").mkdir()
        assert [owner.name for owner in owners()] == ["own"]


def test_a_line_is_found_by_its_name_before_one_that_has_this_port(folder: Path) -> None:
    with served(folder / "a.sock", "slitter"), served(folder / "b.sock", name="slitter") as named:
        assert find_owner("slitter") == named.owner


def test_the_socket_of_an_unknown_line_is_not_found(folder: Path) -> None:
    with pytest.raises(LineDown, match=r"no running line named 'slitter' \(running: none\)"):
        socket_path("slitter")
    with (
        served(folder / "a.sock", "/dev/ttyUSB0", "press"),
        served(folder / "b.sock", "/dev/ttyUSB1", "winder"),
        pytest.raises(LineDown, match=r"no running line named 'slitter' \(running: press, winder\)"),
    ):
        socket_path("slitter")
    assert socket_path("unix:///run/a.sock") == socket_path("unix:/run/a.sock") == "/run/a.sock"


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("2001:db8:0:0::7", "2001:db8::7"),
        ("0.0.0.0", "127.0.0.1"),
        ("::", "127.0.0.1"),
        ("::1", "127.0.0.1"),
        ("127.0.0.1", "127.0.0.1"),
    ],
)
def test_each_address_has_one_spelling(text: str, plain: str) -> None:
    assert plain_address(text) == plain


# the socket


def test_a_path_has_at_most_the_length_that_the_kernel_takes(tmp_path: Path) -> None:
    def path_of(length: int, letter: str) -> Path:
        room = length - len(os.fsencode(tmp_path)) - len("/.sock")
        return tmp_path / f"{letter * (room // len(letter.encode())):x<{room - room // len(letter.encode())}}.sock"

    short = path_of(LONGEST_PATH, "a")
    assert len(os.fsencode(short)) == LONGEST_PATH
    with served(short) as found:
        assert short.is_socket()
        assert found.owner.address == f"unix:{short}"
    for long in (short.with_stem(short.stem + "b"), short.with_stem("\u00fc" + short.stem[1:])):
        with pytest.raises(InvalidCommand, match="has more than 107 bytes; use a shorter path"):
            served(long).__enter__()
    assert os.listdir(tmp_path) == []


def test_a_socket_that_was_removed_meanwhile_ends_all_the_same(tmp_path: Path) -> None:
    before = open_files()
    with served(tmp_path / "a.sock"):
        (tmp_path / "a.sock").unlink()
        (tmp_path / "a.line").unlink()
    assert open_files() == before


def test_a_socket_that_cannot_be_served_keeps_no_file_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.sock"
    before, mask = open_files(), os.umask(0o027)
    path.write_text("mine")
    with pytest.raises(InvalidCommand, match="is not a socket"):
        served(path).__enter__()
    assert os.listdir(tmp_path) == ["a.sock"]
    path.unlink()
    path.symlink_to(tmp_path / "nothing")
    with pytest.raises(InvalidCommand, match="is not a socket"):
        served(path).__enter__()
    path.unlink()
    with served(path):
        during = open_files()
        with pytest.raises(InvalidCommand, match="use it, or stop that process first"):
            served(path).__enter__()
        assert open_files() == during
    with pytest.raises(InvalidCommand, match="cannot be served: No such file or directory"):
        served(tmp_path / "missing" / "a.sock").__enter__()
    monkeypatch.setattr(os, "chmod", lambda *_: os.stat(tmp_path / "missing"))
    with pytest.raises(InvalidCommand, match="cannot be served: No such file or directory"):
        served(path).__enter__()
    assert os.listdir(tmp_path) == []
    assert open_files() == before
    assert os.umask(mask) == 0o027


def test_the_group_with_number_0_gets_the_socket_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "chown", lambda path, user, group: given.append((user, group)))
    with ServedSocket(Owner("a", "x", str(tmp_path / "a.sock"), 1), mode=0o660, group=0):
        assert given == [(-1, 0)]


def test_a_lock_that_an_ending_owner_has_unlinked_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, locked = tmp_path / "a.sock", list[int]()
    flock = fcntl.flock

    def unlink_first(file: int, operation: int) -> None:
        if not locked:
            path.with_suffix(".line").unlink()
        locked.append(file)
        flock(file, operation)

    before = open_files()
    monkeypatch.setattr(fcntl, "flock", unlink_first)
    with served(path):
        assert len(locked) == 2
        assert json.loads(path.with_suffix(".line").read_text())["name"] == "a"
    assert open_files() == before


def test_the_longer_record_of_a_process_that_has_died_is_replaced_as_a_whole(folder: Path) -> None:
    (folder / "a.line").write_text(json.dumps({"name": "a", "port": "/dev/" + "x" * 500, "socket": "", "pid": 1}))
    with served(folder / "a.sock") as found:
        assert find_owner("a") == found.owner
        with pytest.raises(InvalidCommand, match=f"already served by process {os.getpid()}, for /dev/ttyUSB0"):
            served(folder / "a.sock").__enter__()


def test_a_record_that_is_a_link_leads_nowhere(tmp_path: Path) -> None:
    other = tmp_path / "letters"
    other.write_text("mine")
    (tmp_path / "a.line").symlink_to(other)
    with pytest.raises(InvalidCommand, match=r"a\.sock cannot be served: Too many levels of symbolic links"):
        served(tmp_path / "a.sock").__enter__()
    assert other.read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == ["a.line", "letters"]


def test_a_lock_of_an_unreadable_owner_is_another_processs(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with served(path):
        path.with_suffix(".line").write_text("{")
        with pytest.raises(InvalidCommand, match="already served by another process; use it, or stop that process"):
            served(path).__enter__()


def test_a_socket_whose_queue_is_full_is_in_use(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with socket.socket(socket.AF_UNIX) as server, socket.socket(socket.AF_UNIX) as client:
        server.bind(str(path))
        server.listen(0)
        client.connect(str(path))
        assert folders._listens(path)
    assert not folders._listens(path)
    assert not folders._listens(tmp_path / "missing.sock")


def test_no_other_user_may_connect_before_the_mode_is_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[int] = []
    monkeypatch.setattr(os, "chmod", lambda path, _: modes.append(stat.S_IMODE(os.stat(path).st_mode)))
    with served(tmp_path / "a.sock"):
        assert modes == [0o600]


def test_the_port_of_the_other_owner_may_be_written_differently(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with served(path, "localhost:4001"):
        with pytest.raises(InvalidCommand, match="for localhost:4001; use it, or stop that process first"):
            served(path, "socket://127.0.0.1:4001?echo=1").__enter__()
        with pytest.raises(InvalidCommand, match="for localhost:4001; give this line another name"):
            served(path, "127.0.0.1:4002").__enter__()


def test_a_serial_server_whose_host_is_unknown_is_found_by_its_name(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with served(folder / "a.sock", "gateway:4001") as found:
        assert find_owner("socket://gateway:4001?baudrate=9600") == found.owner
        assert find_owner("gateway:4002") is None
