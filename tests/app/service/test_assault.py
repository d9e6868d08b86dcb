"""What programs can do to the owner of a line, as processes. `python -m tests.app.service.assault` does more of it."""

from __future__ import annotations

import asyncio
import random

import pytest

from tests.app.service.assault import assault
from tests.patience import PATIENCE


@pytest.mark.slow
def test_whatever_programs_do_to_it_the_owner_goes_on_and_its_records_are_true() -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE):
            report = await assault(connections=100, kills=2, chance=random.Random(7))
        assert report.complaints == []
        assert report.outcomes["written"]
        assert report.after["cycles"] > report.before["cycles"]

    asyncio.run(run())
