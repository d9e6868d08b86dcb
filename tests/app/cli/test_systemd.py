"""What systemd wants of a service, as its environment says it."""

from __future__ import annotations

import os

import pytest

from busmaster.app.cli.systemd import ServiceManager


@pytest.mark.parametrize(
    ("environment", "interval"),
    [
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "400000"}, 0.4),
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "400000", "WATCHDOG_PID": str(os.getpid())}, 0.4),
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "400000", "WATCHDOG_PID": str(os.getppid())}, 0.0),
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "soon"}, 0.0),
        ({"NOTIFY_SOCKET": "@nobody"}, 0.0),
        ({"WATCHDOG_USEC": "400000"}, 0.0),
    ],
)
def test_a_sign_of_life_is_wanted_of_the_process_that_is_named(environment: dict[str, str], interval: float) -> None:
    manager = ServiceManager(environment)
    manager.ready()  # nobody listens, which is no error
    manager.close()
    assert manager.interval == interval
