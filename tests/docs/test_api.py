"""The page of the API has every public name once, with the signature that a program uses."""

from __future__ import annotations

import re
from importlib import import_module

import pytest

from tests.docs.api import APART, home, modules
from tests.docs.pages import ROOT, anchors

PAGE = ROOT / "docs" / "reference" / "api.md"
TEXT = PAGE.read_text()
SECTIONS = dict(re.findall(r"^## ([\w.]+)\n(.*?)(?=^## |\Z)", TEXT, re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("module", [module for module in modules() if module not in APART])
def test_each_public_name_is_described_once_and_found_from_each_module_that_has_it(module: str) -> None:
    section = SECTIONS[module]
    for name in import_module(module).__all__:
        place = home(module, name)
        constants, _, described = SECTIONS[place.module].partition("\n### ")
        found = re.findall(rf"^### {name}$", f"### {described}", re.MULTILINE)
        found += re.findall(rf"^- \*\*`{name}(?: = [^\n]*)?`\*\*", constants, re.MULTILINE)
        assert len(found) == 1, name
        assert place.module == module or f"[`{name}`](#" in section, name
        assert not place.link or place.link in anchors(PAGE), name


@pytest.mark.parametrize(
    "text",
    [
        "async plan(*more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan",  # keywords after *more
        "worst_case_wait(priority: Priority = Priority.COMMAND) -> float",  # an enum as a default
        "class LineSettings(baudrate: int, bytesize: int = 8, parity: str = 'N', stopbits: float = 1)",  # a dataclass
        "class Quality(Enum)",
        "class BusLike(Protocol)",
        "    late_after: float,\n",  # of a dataclass that accepts old names too
        "    value: T,\n",  # of a NamedTuple
    ],
)
def test_a_signature_is_as_a_program_uses_it(text: str) -> None:
    assert text in TEXT


def test_no_signature_shows_an_address_or_a_wrapper() -> None:
    assert not re.search(r"ForwardRef|object at 0x|<factory>|, self_checked=True|\*args: object", TEXT)


def test_a_name_in_a_docstring_links_to_its_description_and_a_program_stays_a_program() -> None:
    assert "[`RemoteBus`](#remotebus)" in SECTIONS["busmaster"]
    assert "\n    drive = CtAnsiDrive(bus, 12, decimals=" in SECTIONS["busmaster"]
