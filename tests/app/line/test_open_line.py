"""The line that a file describes, opened: on an emulated line, in virtual time."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import busmaster
from busmaster import Bus, BusClosed, InvalidCommand, MemoryPort, NoReply, NotStarted, WriteUnconfirmed
from busmaster.app.config import emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import FileError, Source
from busmaster.app.line import ConfiguredLine, configured_line
from busmaster.app.line.kept_times import KeptTimes
from busmaster.app.outputs.distributor import Distributor
from busmaster.app.service.authorisation import WriteRequest
from busmaster.bus.node import Node
from busmaster.emulator.serve import serve_tcp
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.testing import run_in_virtual_time

TEXT = """
port = "/dev/ttyUSB0"
[nodes.winder]
protocol = "hcp2"
address = 1
[nodes.winder.points]
force = { item = "10", unit = "N", factor = 0.1 }
[nodes.drive2-3]
protocol = "microflex"
address = "2-3"
[groups.fast]
period = 0.1
points = ["winder/force,11", "drive2-3/speed_measured"]
[groups.slow]
period = 1
phase = 0.5
points = "winder/inputs"
"""


def opened(text: str = TEXT) -> ConfiguredLine:
    """On its own emulation."""
    file = read(Source("line.toml", text))
    return ConfiguredLine(file, port=MemoryPort(emulated_line(file)))


def test_a_protocol_that_sends_decimal_points_rounds_by_decimals_and_scales_nothing() -> None:
    text = """
port = "/dev/ttyS0"
[nodes.belt]
protocol = "ct-ansi"
address = 12
points = { reference = { item = "1.21", decimals = 1 } }
"""

    async def main() -> None:
        async with opened(text) as line:
            await line.point("belt/reference").write(-47.64)
            assert await line.point("belt/reference").read() == -47.6

    run_in_virtual_time(main())


def test_nodes_and_groups_are_there_by_name_and_polled() -> None:
    async def main() -> None:
        async with opened() as line:
            winder = line.nodes["winder"]
            assert isinstance(winder, Hcp2Controller)
            await winder.write(10, 125, 7)
            async for snapshot in line.groups["fast"]:
                values = {point.key: sample.value for point, sample in snapshot.samples.items()}
                break
            assert values["winder/force"] == 12.5
            assert values["winder/11"] == 7
            assert set(values) == {"winder/force", "winder/11", "drive2/speed_measured", "drive3/speed_measured"}
            assert snapshot[line.point("winder/force")].value == 12.5
            assert line.groups["slow"].period == 1

    run_in_virtual_time(main())


def test_a_point_is_read_and_written_on_its_scale_and_a_write_makes_samples_stale() -> None:
    async def main() -> None:
        async with opened() as line:
            point = line.point("winder/force")
            await point.write(4.5)
            assert await point.read() == 4.5
            assert await line.nodes["winder"].point("10").read() == 45
            assert line.bus.latest(point) is None

    run_in_virtual_time(main())


def test_it_is_closed_when_it_is_left() -> None:
    async def main() -> None:
        async with opened() as line:
            pass
        with pytest.raises(BusClosed):
            await line.point("winder/11").read()
        # an output is closed last, and can still receive a command
        command = WriteRequest(interface="mqtt", by="hmi", name="winder/11", point=line.point("winder/11"), value=1)
        assert (await line.authorisation.write(command)).error == "the line is closing; nothing was sent"

    run_in_virtual_time(main())


@pytest.mark.parametrize("part", ["outputs", "learned times"])
@pytest.mark.parametrize("error", [InvalidCommand("no thread can be started"), asyncio.CancelledError()])
def test_a_line_that_cannot_be_entered_is_closed_again(
    monkeypatch: pytest.MonkeyPatch, part: str, error: BaseException
) -> None:
    def fails(*_: object) -> None:
        raise error

    async def main() -> None:
        before = asyncio.all_tasks()
        line = opened()
        monkeypatch.setattr(line.outputs if part == "outputs" else KeptTimes, "start", fails)
        with pytest.raises(type(error)):
            await line.__aenter__()
        with pytest.raises(BusClosed):
            await line.point("winder/11").read()
        assert asyncio.all_tasks() == before

    run_in_virtual_time(main())


def test_outputs_are_closed_also_if_the_closing_of_the_port_is_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Distributor] = []
    close, leave = Distributor.close, Bus.__aexit__

    async def close_outputs(outputs: Distributor) -> None:
        closed.append(outputs)
        await close(outputs)

    async def leave_bus(*arguments: Any) -> None:
        await leave(*arguments)
        raise asyncio.CancelledError

    async def main() -> None:
        line = await opened().__aenter__()
        monkeypatch.setattr(Distributor, "close", close_outputs)
        monkeypatch.setattr(Bus, "__aexit__", leave_bus)
        with pytest.raises(asyncio.CancelledError):
            await line.__aexit__(None, None, None)
        assert closed == [line.outputs]

    run_in_virtual_time(main())


def test_a_reply_time_of_0_in_the_file_is_the_one_of_the_plan() -> None:
    line = opened(TEXT.replace("address = 1\n", "address = 1\nreply_time = 0\n"))
    assert Node.of(line.nodes["winder"]).planned().reply_time == 0
    assert Node.of(line.nodes["drive2"]).planned().reply_time != 0


def test_a_long_run_of_an_msc_is_written_through_its_handle() -> None:
    text = """
port = "/dev/ttyUSB0"
[nodes.press]
protocol = "msc"
address = 1
address_step = 4
symbols = { cam = 3000 }
[nodes.press.points]
profile = { item = "cam:40", unit = "mm", factor = 0.001 }
"""

    async def main() -> None:
        async with opened(text) as line:
            await line.point("press/profile").write([i / 8 for i in range(40)])
            found = await line.nodes["press"].point("cam:40").read()
            assert found == tuple(125 * i for i in range(40))

    run_in_virtual_time(main())


CAM = """
port = "/dev/ttyUSB0"
[nodes.press]
protocol = "msc"
address = 1
address_step = 4
points.profile = { item = "3000:40" }
points.length = { item = "2008" }
"""


@pytest.mark.parametrize(("name", "value"), [("profile", 40 * [1]), ("length", 1)])
def test_a_write_to_a_point_has_the_options_that_it_is_given(name: str, value: object) -> None:
    async def main() -> None:
        async with opened(CAM) as line:
            reading = asyncio.ensure_future(line.point("press/2012").read())
            await asyncio.sleep(0)  # the write waits until it has its reply
            with pytest.raises(NotStarted):
                await line.point(f"press/{name}").write(value, start_within=1e-6)
            assert await reading == 0

    run_in_virtual_time(main())


@pytest.mark.parametrize("name", ["length", "2008"])
def test_a_value_with_decimals_for_a_whole_number_without_a_scale_is_refused_and_not_rounded(name: str) -> None:
    with pytest.raises(InvalidCommand, match=r"a value must be a whole number, not 4\.7"):
        opened(CAM).prepare_write(f"press/{name}", [4.7])


def test_a_node_answers_by_its_name_in_errors() -> None:
    text = TEXT + "[emulator.nodes.drive2]\nfaults = { dead = 1 }\n"

    async def main() -> None:
        async with opened(text) as line:
            with pytest.raises(WriteUnconfirmed, match=r"^drive2: "):
                await line.nodes["drive2"].point("1").write(1.0)

    run_in_virtual_time(main())


def test_no_such_point_is_said_with_what_there_is() -> None:
    line = opened()
    for name, complaint in (("winder", "NODE/ITEM"), ("wind/1", "winder, drive2, drive3"), ("winder/forse", "'force'")):
        with pytest.raises(InvalidCommand, match=complaint):
            line.point(name)


def test_a_point_that_is_not_writable_is_refused_under_its_name() -> None:
    line = opened(TEXT.replace("[nodes.drive2-3]", 'held = { item = "12", writable = false }\n[nodes.drive2-3]'))
    for name, what in (
        ("held", "^winder/held is read-only$"),
        ("axis0.position", "^winder/axis0.position is read-only$"),
    ):
        with pytest.raises(InvalidCommand, match=what):
            line.prepare_write(f"winder/{name}", [1])
    assert callable(line.prepare_write("winder/force", [1]))


def test_a_prepared_write_has_the_options_that_it_is_given() -> None:
    async def main() -> list[int]:
        async with opened(TEXT.partition("[groups.fast]")[0]) as line:
            attempts = []
            for value in (1.0, 2.0, 3.0):
                await line.prepare_write("winder/force", [value], verify=value == 3.0)()
                attempts.append(Node.of(line.nodes["winder"]).statistics().attempts)
            return attempts

    first, second, third = run_in_virtual_time(main())
    assert (second - first, third - second) == (1, 2), "only the last one is read back"


def test_the_plan_counts_each_group_once_whether_it_runs_or_not() -> None:
    async def main() -> None:
        line = opened()
        before = [(group.name, group.values) for group in line.plan().groups]
        async with line:
            assert [(group.name, group.values) for group in line.plan().groups] == before
        assert before == [("fast", 4), ("slow", 1)]

    run_in_virtual_time(main())


def test_groups_run_with_the_phase_and_the_priority_by_which_they_are_planned() -> None:
    text = TEXT.replace("period = 0.1", "period = 0.1\nphase = 0.03").replace("phase = 0.5", "phase = 0.03")
    text = text.replace('points = "winder/inputs"', 'points = "winder/inputs"\npriority = "background"')
    plans = []

    async def main(text: str) -> None:
        line = opened(text)
        before = line.plan()
        async with line:
            assert line.plan() == before
        plans.append(before)

    for other in (text, text.replace("phase = 0.03\n", ""), text.replace('priority = "background"', "")):
        run_in_virtual_time(main(other))
    assert plans[0] not in plans[1:]


def test_a_read_is_repeated_as_often_as_the_file_says() -> None:
    async def main(retries: int) -> int:
        text = TEXT.replace("address = 1\n", f"address = 1\nretries = {retries}\n")
        async with opened(f"{text}[emulator.nodes.winder]\nfaults = {{ dead = 1 }}\n") as line:
            line.groups["fast"].pause()
            line.groups["slow"].pause()
            with pytest.raises(NoReply):
                await line.nodes["winder"].read(10)
            return Node.of(line.nodes["winder"]).statistics().retries

    assert [run_in_virtual_time(main(retries)) for retries in (0, 1)] == [0, 1]


def test_a_strict_line_takes_longer_because_it_holds_ambiguous_replies() -> None:
    async def main(text: str) -> float:
        async with opened(text.partition("[groups.fast]")[0]) as line:
            await line.nodes["winder"].read(10)
            began = line.bus.now()
            for _ in range(10):
                await line.nodes["winder"].read(10)
            return line.bus.now() - began

    assert run_in_virtual_time(main(f"strict = true{TEXT}")) > run_in_virtual_time(main(TEXT))


def test_a_tap_receives_the_bytes_of_a_line_that_is_opened() -> None:
    received: list[bytes] = []
    tap: Any = SimpleNamespace(
        transmitted=lambda now, data, attempt: None,
        received=lambda now, data, attempt: received.append(data),
        attempted=lambda attempt: None,
    )

    async def main() -> None:
        file = read(Source("line.toml", TEXT))
        async with ConfiguredLine(file, port=MemoryPort(emulated_line(file)), tap=tap) as line:
            await line.nodes["winder"].read(10)

    run_in_virtual_time(main())
    assert received


@pytest.mark.parametrize("outputs", [True, False])
@pytest.mark.asyncio
async def test_open_line_opens_the_port_of_the_file_and_passes_its_options_on(tmp_path: Path, outputs: bool) -> None:
    received: list[bytes] = []
    tap: Any = SimpleNamespace(
        transmitted=lambda now, data, attempt: None,
        received=lambda now, data, attempt: received.append(data),
        attempted=lambda attempt: None,
    )
    text = TEXT.partition("[groups.fast]")[0] + f'[outputs.jsonl]\npath = "{tmp_path / "line.jsonl"}"\n'
    path = tmp_path / "line.toml"
    emulated = emulated_line(read(Source("line.toml", text)))
    emulated.paced = False
    with serve_tcp(emulated) as server:
        path.write_text(text.replace("/dev/ttyUSB0", server.path))
        async with busmaster.open_line(path, outputs=outputs, tap=tap) as line:
            assert await line.nodes["winder"].read(10) == 0
            assert [output.kind for output in line.outputs.statistics()] == ["jsonl"] * outputs
    assert received


def test_outputs_report_the_state_of_a_line_only_in_the_process_that_polls_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[object, object]] = []

    class Noted(Distributor):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            made.append((options.get("in_charge", True), options.get("asks", True)))
            super().__init__(*arguments, **options)

    monkeypatch.setattr(configured_line, "Distributor", Noted)
    kinds = ("csv", "jsonl", "sqlite")
    outputs = "".join(f'[outputs.{kind}]\npath = "{tmp_path / kind}"\n' for kind in kinds)
    file = read(Source("line.toml", TEXT + outputs))
    assert [output.kind for output in ConfiguredLine(file).audit().statistics()] == ["jsonl", "sqlite"]
    ConfiguredLine(file, asks=False)
    assert made == [(True, True), (False, True), (True, False)]


def test_an_audit_output_whose_extra_is_missing_is_named_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = opened(f'{TEXT}[outputs.jsonl]\npath = "{tmp_path / "audit"}"\n[outputs.mqtt]\n')
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(FileError, match=r"^line\.toml:\d+: outputs\.mqtt: .* pip install 'busmaster\[mqtt\]'"):
        line.audit()


def test_a_symbol_that_looks_like_a_range_is_one_point() -> None:
    text = 'port = "/dev/ttyUSB0"\n[nodes.press]\nprotocol = "msc"\naddress = 1\nsymbols = { a1-3 = 3000 }\n'
    group = '[groups.g]\nperiod = 1\npoints = "press/a1-3"\n'
    line = ConfiguredLine(read(Source("line.toml", text + group)), outputs=False)
    assert [point.key for point in line.members("g")] == ["press/a1-3"]


def test_open_line_reads_a_file_and_says_where_it_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(TEXT)
    assert list(busmaster.open_line(path).nodes) == ["winder", "drive2", "drive3"]
    path.write_text(TEXT.replace("winder/inputs", "winder/input"))
    with pytest.raises(InvalidCommand, match=r"line\.toml:17: groups\.slow\.points\[1\]: .*did you mean 'inputs'\?"):
        busmaster.open_line(path)
    with pytest.raises(FileNotFoundError):
        busmaster.open_line(tmp_path / "none.toml")
