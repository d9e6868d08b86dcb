"""What a served line is called, and who is found by that."""

from __future__ import annotations

from pathlib import Path

import pytest

from busmaster import Hcp2Controller, Service, connect
from busmaster.errors import InvalidCommand, LineDown
from tests.app.service.lines import Served, on_a_line


def test_who_waits_for_the_owner_of_a_line_to_come_back_waits_for_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))

    async def story(line: Served) -> None:
        for _ in range(2):
            with pytest.raises(LineDown, match=r"no running line named 'slitter' \(running: "):
                await connect("slitter").__aenter__()
            async with Service(line.bus, name="slitter"), connect("slitter") as remote:
                assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("name", ["a/b", "../slitter", "", ".sock", "x" * 61])
def test_a_line_is_called_what_a_socket_can_be_called(tmp_path: Path, name: str) -> None:
    async def story(line: Served) -> None:
        with pytest.raises(InvalidCommand, match="is not a name of a line; use "):
            Service(line.bus, name=name)

    on_a_line(tmp_path, story)
