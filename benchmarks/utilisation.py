"""How much of what the wire can carry is carried, at real baud rates and device reply times.

The limit of the wire is bits and reply time and nothing else: requests, replies, the host's ACK in MSC, the device's
reply time, and the 1.75 ms of silence that Modbus wants before a request. The responder keeps the reply time by its own
precise clock. Beside ours runs the bare asyncio.Protocol loop, which keeps that silence by a timer of its own: what it
does not reach, this machine cannot.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from statistics import mean

from benchmarks.harness import Claim, Options, Outcome, Table, alternate
from benchmarks.lines import Lines
from benchmarks.masters import Bare, Ours, Question
from benchmarks.questions import hcp2_questions, modbus_questions, msc_questions, wire_time
from busmaster import LineSettings
from busmaster.ext import Profile
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc

BAUDRATES = (9600, 57600, 115200)
REPLY_TIMES = (0.0, 0.002, 0.02)
CLAIMED_REPLY_TIME = 0.002
OF_THE_WIRE = 98.0
OF_BARE = 97.0
OF_BARE_WITH_SILENCE = 98.5
MODBUS = replace(modbus.PROFILE, line=LineSettings(BAUDRATES[1]))  # 8N1, as the pty
COLUMNS = ("line", "reply time ms", "wrong", "limit /s", "ours /s", "% of limit", "bare % of limit", "% of bare")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("Transactions a second against the limit of the wire", COLUMNS)
    kinds = ((hcp2.PROFILE, hcp2_questions()), (msc.PROFILE, msc_questions()), (MODBUS, modbus_questions()))
    for profile, questions in kinds:
        for baudrate in BAUDRATES:
            for delay in options.pick(REPLY_TIMES, (CLAIMED_REPLY_TIME,)):
                asyncio.run(_measure(profile, questions, baudrate, delay, options, table, outcome))
    outcome.tables.append(table)
    return outcome


async def _measure(
    profile: Profile,
    questions: Sequence[Question],
    baudrate: int,
    delay: float,
    options: Options,
    table: Table,
    outcome: Outcome,
) -> None:
    settings = LineSettings(baudrate)
    limit = 1 / mean(wire_time(ask, settings, delay) for ask in questions)
    ours, bare = Ours(profile, questions), Bare(questions, profile.timings.read.driver_release_time)
    round_length = options.pick(0.5, 0.05)
    transactions = max(1, round(round_length * limit / len(questions))) * len(questions)
    replies = {ask.request: ask.reply for ask in questions}
    with Lines(2, replies, settings=settings, delay=delay, swallow=questions[0].closing) as lines:
        await ours.open(lines.ports[0])
        await bare.open(lines.ports[1])
        await bare.run(1)
        timings = await alternate({"ours": ours.run, "bare": bare.run}, transactions, options.pick(9, 2))
        await ours.close()
        await bare.close()
    share = 100 / timings["ours"].each / limit
    bare_share = 100 / timings["bare"].each / limit
    of_bare = 100 / timings["ours"].ratio(timings["bare"])
    name = f"{profile.name} {baudrate}"
    rate = 1 / timings["ours"].each
    table.row(name, delay * 1000, timings["ours"].wrong, limit, rate, share, bare_share, of_bare)
    outcome.wrong += timings["ours"].wrong
    outcome.series[f"{name}, {delay * 1000:g} ms"] = {"ours": share, "bare": bare_share}
    if delay == CLAIMED_REPLY_TIME:
        if baudrate == min(BAUDRATES):
            outcome.claims.append(Claim(f"% of the wire's limit, {name}", share, OF_THE_WIRE, at_most=False))
        else:
            least = OF_BARE_WITH_SILENCE if profile is MODBUS else OF_BARE
            outcome.claims.append(Claim(f"% of the bare loop's rate, {name}", of_bare, least, at_most=False))
