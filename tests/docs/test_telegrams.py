"""The telegrams on the pages of docs/ are the codecs': each side says the very bytes that are shown."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from busmaster.contract.driver import Driver, Ending
from busmaster.errors import NoSuchParameter, Refused
from busmaster.registry import NodeKind, find, kinds, make_device, protocols
from busmaster.testing import Case, answers_of, check_dialect
from tests.docs.pages import PAGES, ROOT, blocks

VECTORS = json.loads((ROOT / "tests" / "vectors" / "frames.json").read_text())
DONE = "done"
REFUSALS = {kind.__name__: kind for kind in (Refused, NoSuchParameter)}


def value_of(node: ast.expr) -> Any:
    """What a literal stands for; `range(32)` stands for the tuple of that."""
    if isinstance(node, ast.Call):
        return tuple(range(ast.literal_eval(node.args[0])))
    return ast.literal_eval(node)


class Telegrams:
    """One example of a page: `KIND ADDRESS: command(arguments)`, then what each side says, then how it ends.

    `>` is the host, `<` the node, `=` the outcome; two spaces go on with the line above. `KIND ADDRESS hears:` has no
    command, for what no command of ours would send: there the emulated device alone is asked.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        lines = re.sub(r"\n  +", " ", re.sub(r"\s+#.*", "", text)).strip().splitlines()
        head, _, self.command = lines[0].partition(":")
        kind, address, *hears = head.split()
        self.kind, self.address, self.known = find(kind), int(address), not hears
        self.said = [(line[0], bytes.fromhex(line[1:])) for line in lines[1:] if line[0] in "<>"]
        self.outcome = next((line[1:].strip() for line in lines if line[0] == "="), "")

    def __str__(self) -> str:
        return self.text.splitlines()[0]

    def built(self) -> Any:
        call: Any = ast.parse(self.command.strip(), mode="eval").body
        arguments = {argument.arg: value_of(argument.value) for argument in call.keywords}
        return self.kind.protocol.read_back({"command": call.func.id, **arguments})

    def check_codec(self) -> None:
        driver = Driver(self.built().open(self.address, self.kind.profile.timings))
        turn = 0
        for side, data in self.said:
            if side == "<":
                driver.feed(data)
                continue
            closing = driver.ending.send if driver.ending is not None else b""
            says = [driver.exchange.request, *driver.sent, closing][turn]
            assert data == says, f"{self}: the host says {says.hex(' ')!r}, not {data.hex(' ')}"
            turn += 1
        self.check_outcome(driver.run_out())

    def check_outcome(self, ending: Ending) -> None:
        if isinstance(ending.error, Refused):
            assert self.outcome == type(ending.error).__name__, f"{self}: {ending}"
        else:
            assert ending.delivered, f"{self}: {ending}"
            wanted = None if self.outcome == DONE else value_of(ast.parse(self.outcome, mode="eval").body)
            assert ending.value == wanted, f"{self}: {ending}"

    def check_device(self) -> None:
        """The emulated device takes the request for one of its own; where no command sends it, says just that."""
        host = self.said[0][1]
        told = b"".join(data for side, data in self.said if side == "<")
        profile = self.kind.profile
        address = profile.addresses[0] if self.address == profile.broadcast else self.address
        heard = answers_of(make_device(self.kind.name, address))(host)
        if self.known:
            assert bool(heard) is bool(told), f"{self}: the emulated device answers {heard.hex(' ')!r}"
        else:
            assert heard == told, f"{self}: the emulated device answers {heard.hex(' ')!r}"


def examples() -> Iterator[tuple[str, Telegrams]]:
    for page in PAGES:
        for block in blocks(page, "telegrams"):
            for part in re.split(r"\n{2,}", block.text.strip()):
                yield page.stem, Telegrams(part)


EXAMPLES = list(examples())


@pytest.mark.parametrize("example", [example for _, example in EXAMPLES if example.known], ids=str)
def test_the_codec_sends_and_reads_the_very_bytes_of_an_example(example: Telegrams) -> None:
    example.check_codec()


@pytest.mark.parametrize("example", [example for _, example in EXAMPLES if example.known], ids=str)
def test_a_listener_reads_an_example_off_the_line(example: Telegrams) -> None:
    steps = [data for side, data in example.said if side == "<"]
    raises = REFUSALS.get(example.outcome)
    check_dialect(example.kind.protocol, [Case(example.built(), example.address, steps, raises=raises)])


@pytest.mark.parametrize("example", [example for _, example in EXAMPLES], ids=str)
def test_the_emulated_device_answers_the_request_of_an_example(example: Telegrams) -> None:
    example.check_device()


@pytest.mark.parametrize("protocol", protocols(), ids=lambda protocol: protocol.name)
def test_each_protocol_has_a_page_with_examples_of_every_command_but_those_that_merge_others(protocol: Any) -> None:
    shown = {
        example.command.partition("(")[0].strip()
        for page, example in EXAMPLES
        if example.known and page == protocol.name
    }
    assert shown == {name for name in protocol.commands if not name.startswith("pick_")}


@pytest.mark.parametrize("family", VECTORS)
def test_every_frame_of_the_vectors_is_on_its_page(family: str) -> None:
    shown = {data for page, example in EXAMPLES if page == family.lower() for _, data in example.said}
    assert [entry["name"] for entry in VECTORS[family] if bytes.fromhex(entry["hex"]) not in shown] == []


SAID_ONCE = re.compile(r"(axis|adc)[1-7]")
"""Of items that are alike for each axis and channel the pages have the first."""


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: str(kind.name))
def test_every_item_that_has_a_name_is_on_its_page_with_its_unit_and_access(kind: NodeKind) -> None:
    """Two kinds on one page may have an item of one name and number: one row of the tables suits each."""
    page = (ROOT / "docs" / "protocols" / f"{kind.protocol.name}.md").read_text()
    named = [item for item in kind.documented if re.fullmatch(r"(axis0\.)?[a-z]\w*", item.item)]
    for item in (item for item in named if not SAID_ONCE.match(item.item)):
        assert item.item in page, f"{item.item} is not on the page"
        rows = [line for line in page.splitlines() if line.startswith(f"| {item.number} | `{item.item}` |")]
        suits = [row for row in rows if ("| R/W |" in row) is (item.access == "read/write") and item.unit in row]
        assert suits or not rows, f"{item.item} is {item.access} in {item.unit or 'no unit'}, not {rows}"
