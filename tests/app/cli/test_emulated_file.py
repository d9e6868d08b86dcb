"""A LINE.toml polled against its own emulator, a process of its own: no errors, and the values it says."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import pytest
import serial

from busmaster.app.cli.emulate import own_port
from busmaster.app.cli.lines import other_port
from busmaster.app.config import load
from busmaster.app.line import ConfiguredLine
from busmaster.bus.node import Node
from busmaster.bus.samples import Sample
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort
from tests.app.cli.conftest import ROOT, started
from tests.app.config.test_emulated import HEAD, VALUES
from tests.patience import PATIENCE

EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))


@contextmanager
def emulated(path: Path, link: str, *options: str) -> Iterator[None]:
    """`busmaster emulate LINE.toml` as a process, on a pseudo-terminal."""
    with started("emulate", str(path), *options) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            assert process.stdout.readline().strip() == link, process.stderr.read()
            yield
        finally:
            process.terminate()


def polled(path: Path, link: str | None = None) -> dict[str, Sample[Any]]:
    """One cycle of every group, at the file's port or another, in which no node of the line has failed a request.

    A few are tried: on a busy machine the emulator, a process of its own, may answer later than any drive.
    """
    file = load(path)

    async def poll() -> tuple[dict[str, Sample[Any]], int]:
        async with ConfiguredLine(file, port=other_port(file, link), outputs=False) as line:
            snapshots = [await anext(aiter(group)) for group in line.groups.values()]
            failed = sum(Node.of(handle).statistics().failed for handle in line.nodes.values())
        return {getattr(point, "key", ""): sample for one in snapshots for point, sample in one.items()}, failed

    for _ in range(5):
        samples, failed = asyncio.run(asyncio.wait_for(poll(), PATIENCE))
        if not failed:
            break
    assert not failed
    return samples


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_an_example_polls_clean_against_its_own_emulator(path: Path, tmp_path: Path) -> None:
    link = str(tmp_path / "line")
    with emulated(path, link, "--pty", link, "--fault", "lost=0"):  # in place of the faults that a file asks for
        samples = polled(path, link)
    assert samples
    assert {key: sample.error for key, sample in samples.items() if sample.error is not None} == {}


def file_of(text: str, points: Iterable[str], folder: Path) -> tuple[Path, str]:
    """A file with these points in a group, whose port is a link beside it."""
    path, link = folder / "line.toml", str(folder / "line")
    wanted = json.dumps([f"n/{point}" for point in points])
    group = f"[groups.all]\nperiod = 0.25\npoints = {wanted}\n"
    path.write_text(f"{text.replace(HEAD, f'port = {json.dumps(link)}' + chr(10))}\n{group}")
    return path, link


@pytest.mark.slow
@pytest.mark.parametrize(("text", "kind", "wanted"), VALUES, ids=[kind for _, kind, _ in VALUES])
def test_a_line_with_options_and_values_polls_clean_against_its_own_emulator(
    text: str, kind: str, wanted: dict[str, Any], tmp_path: Path
) -> None:
    path, link = file_of(text, wanted, tmp_path)
    with emulated(path, link):
        samples = polled(path)
    assert {key.partition("/")[2]: sample.value for key, sample in samples.items()} == wanted, kind


@pytest.mark.slow
def test_run_shows_what_the_emulated_line_holds(tmp_path: Path) -> None:
    text, _, wanted = next(one for one in VALUES if one[1] == "msc")
    path, link = file_of(text, wanted, tmp_path)
    with emulated(path, link), started("run", str(path), "--plain") as process:
        assert process.stdout is not None
        shown = dict(process.stdout.readline().split(maxsplit=2)[1:] for _ in wanted)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    assert (shown["n/count"], shown["n/cam:3"], shown["n/flag:5"], shown["n/3004"]) == (
        "1.25\n",
        "5,-6,7\n",
        "1\n",
        "-6\n",
    )


@pytest.mark.slow
def test_emulate_reports_another_baud_rate_of_its_client() -> None:
    with started("emulate", "--protocol", "hcp2") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            with serial.Serial(process.stdout.readline().strip(), 9600) as port:
                port.write(b"\x07")
                assert process.stderr.readline().startswith("busmaster: /dev/")
        finally:
            process.terminate()
        assert process.stderr.read() == ""


@pytest.mark.slow
def test_emulate_says_where_the_file_asks_for_what_no_device_has(tmp_path: Path) -> None:
    path, _ = file_of(VALUES[0][0].replace("outputs = 5", "outptus = 5"), ["outputs"], tmp_path)
    with started("emulate", str(path)) as process:
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (2, "")
    assert f"{path}:7: emulator.nodes.n.values.outptus: " in err
    assert "did you mean 'outputs'?" in err
    assert len(err.splitlines()) == 1


def test_a_line_behind_rfc_2217_is_emulated_only_on_a_port_that_is_named() -> None:
    with pytest.raises(click.UsageError, match="does not support RFC 2217; use --tcp or --pty"):
        own_port(Rfc2217Port("server", 4001, baudrate=9600))
    assert own_port(TcpPort("server", 4001)) == (None, ("server", 4001))


def test_another_port_for_a_file_with_a_tcp_port_is_framed_as_its_protocol_wants(tmp_path: Path) -> None:
    port = other_port(load(ROOT / "examples" / "line-mentor.toml"), "/dev/ttyS0")
    assert port == SerialPort("/dev/ttyS0", baudrate=9600, bytesize=7, parity="E")
