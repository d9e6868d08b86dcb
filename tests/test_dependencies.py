"""The versions of dependencies: those that pyproject.toml lets in, and those with which the tests run."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parent.parent
CONSTRAINTS = ROOT / ".ci" / "constraints.txt"


def required() -> Iterator[Requirement]:
    """Each requirement of each extra, but for those that name other extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for texts in (project["dependencies"], *project["optional-dependencies"].values()):
        for requirement in map(Requirement, texts):
            if requirement.name != project["name"]:
                yield requirement


def test_each_dependency_has_a_lowest_version() -> None:
    for requirement in required():
        assert any(each.operator == ">=" for each in requirement.specifier), requirement


@pytest.mark.skipif(not CONSTRAINTS.exists(), reason="only a checkout has .ci")
def test_the_versions_of_the_tests_are_exact_allowed_and_name_no_registry() -> None:
    lines = [line for line in CONSTRAINTS.read_text().splitlines() if not line.startswith("#")]
    pinned: dict[str, list[tuple[Version, Marker | None]]] = {}
    for line in lines:
        assert re.fullmatch(r"[\w.-]+==[\w.]+( ; .*)?", line), line
        requirement = Requirement(line)
        [exact] = requirement.specifier
        pinned.setdefault(canonicalize_name(requirement.name), []).append((Version(exact.version), requirement.marker))
    for requirement in required():
        for version, _ in pinned[canonicalize_name(requirement.name)]:
            assert version in requirement.specifier, requirement
