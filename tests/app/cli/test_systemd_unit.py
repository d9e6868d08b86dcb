"""The unit that is shipped: what systemd says of its exposure, and that the program still has what it needs."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.app.cli.conftest import ROOT

UNIT = ROOT / "examples" / "busmaster@.service"
TENTHS = 30
"""The most that its exposure may be, in tenths. It is 2.0 with systemd 252; other versions weigh differently."""
MAJORS = {"ttyS": 4, "ttyACM": 166, "ttyUSB": 188, "ttyAMA": 204}
"""Numbers of the kernel's list of allocated devices."""


def settings() -> list[tuple[str, str]]:
    """Key and value of each line of the unit."""
    lines = (line for line in UNIT.read_text().splitlines() if line and line[0] not in "#[")
    return [(key, value) for key, _, value in (line.partition("=") for line in lines)]


def test_systemd_finds_its_exposure_small() -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    helped = subprocess.run([program, "--help"], capture_output=True, text=True, check=False)
    if "--offline" not in helped.stdout:
        pytest.skip("this systemd-analyze cannot look at a file that is not installed (--offline)")
    command = [program, "security", "--no-pager", "--offline=true", f"--threshold={TENTHS}", str(UNIT)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "Overall exposure level" in ran.stdout, ran.stderr
    assert ran.returncode == 0, ran.stdout
    assert "ignoring" not in ran.stderr  # a key or value that systemd does not know


def test_it_leaves_the_program_what_it_needs() -> None:
    said = settings()
    keys = {key for key, _ in said}
    assert not keys & {"PrivateDevices", "PrivateNetwork", "PrivateUsers", "ProcSubset", "ProtectProc", "IPAddressDeny"}
    assert ("DevicePolicy", "closed") in said
    assert {value for key, value in said if key == "DeviceAllow"} == {f"char-{number} rw" for number in MAJORS.values()}
    [families] = (set(value.split()) for key, value in said if key == "RestrictAddressFamilies")
    assert families >= {"AF_UNIX", "AF_INET", "AF_INET6"}
    filters = [value for key, value in said if key == "SystemCallFilter"]
    assert filters.index("@chown") > filters.index(
        "~@privileged @resources"
    )  # later lines hold: the socket has a group


def test_the_device_numbers_are_those_of_this_kernel() -> None:
    text = Path("/proc/devices").read_text().partition("Block")[0]
    found = {name: int(number) for number, name in re.findall(r"^ *(\d+) (\S+)$", text, re.MULTILINE)}
    for name, major in MAJORS.items():
        assert found.get(name, major) == major
