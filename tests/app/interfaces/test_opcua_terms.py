"""What OPC UA calls a value, a write, a unit and whoever comes."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest
from asyncua import ua
from asyncua.common.utils import ServiceError

from busmaster.app.interfaces.opcua_access import Rules, Users
from busmaster.app.interfaces.opcua_terms import (
    CODES,
    is_beyond,
    range_of,
    status_of_sample,
    status_of_write,
    time_of,
    type_of,
    unit_of,
    variant_of,
    widened,
)
from busmaster.app.service.permission import digest_of
from busmaster.arbiter.transaction import Timeline
from busmaster.bus.samples import Quality, Sample
from busmaster.errors import (
    BusClosed,
    BusError,
    GarbledReply,
    InvalidCommand,
    LineDown,
    LineNoisy,
    NodeDown,
    NoReply,
    NoSuchParameter,
    NotStarted,
    Refused,
    VerifyFailed,
    WriteUnconfirmed,
)

KINDS = ua.VariantType
TOKEN = "0123456789abcdef"


def sample(error: BusError | None, quality: Quality) -> Sample[Any]:
    timeline = Timeline(*[0] * len(Timeline._fields))
    return Sample(None if error else 1.0, error, 0.0, 0.0, 0.0, quality, timeline, 0.0)


@pytest.mark.parametrize(
    ("error", "quality", "status"),
    [
        (None, Quality.GOOD, CODES.Good),
        (None, Quality.LATE, CODES.Good),
        (None, Quality.STALE, CODES.UncertainLastUsableValue),
        (NoReply("x"), Quality.BAD, CODES.BadNoCommunication),
        (NodeDown("x"), Quality.BAD, CODES.BadNoCommunication),
        (LineDown("x"), Quality.BAD, CODES.BadNoCommunication),
        (GarbledReply("x"), Quality.BAD, CODES.BadCommunicationError),
        (LineNoisy("x"), Quality.BAD, CODES.BadCommunicationError),
        (Refused("x"), Quality.BAD, CODES.BadDeviceFailure),
        (NoSuchParameter("x"), Quality.BAD, CODES.BadConfigurationError),
        (BusError("x"), Quality.BAD, CODES.BadNoCommunication),
    ],
)
def test_a_value_has_the_status_of_what_became_of_its_read(
    error: BusError | None, quality: Quality, status: int
) -> None:
    assert status_of_sample(sample(error, quality)) == status


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (None, CODES.Good),
        (InvalidCommand("x"), CODES.BadRequestNotAllowed),
        (Refused("x"), CODES.BadRequestNotAllowed),
        (NotStarted("x"), CODES.BadNoCommunication),
        (NodeDown("x"), CODES.BadNoCommunication),
        (LineDown("x"), CODES.BadNoCommunication),
        (BusClosed("x"), CODES.BadNoCommunication),
        (WriteUnconfirmed("x"), CODES.BadTimeout),
        (VerifyFailed("x"), CODES.BadTimeout),
        (NoReply("x", attempts=1), CODES.BadTimeout),
    ],
)
def test_a_write_that_may_have_been_carried_out_is_a_timeout_and_no_other_is(
    error: Exception | None, status: int
) -> None:
    assert status_of_write(error) == status


def test_a_quantity_that_was_whole_by_chance_stays_a_double() -> None:
    assert [type_of(value) for value in (True, 1, 1.5, "x", (1, 2.5))] == [
        *(KINDS.Boolean, KINDS.Int64, KINDS.Double, KINDS.String, KINDS.Double),
    ]
    assert widened(None, 7) is KINDS.Int64
    assert widened(KINDS.Int64, 7.5) is KINDS.Double
    assert widened(KINDS.Double, 7) is KINDS.Double
    assert widened(KINDS.Double, "x") is KINDS.String
    assert variant_of(7, KINDS.Double).Value == 7.0
    assert [type_of(value) for value in (2**63 - 1, -(2**63), 2**63)] == [KINDS.Int64, KINDS.Int64, KINDS.Double]
    nothings: tuple[Any, ...] = (None, (), {}, (1, "x"))
    for nothing in nothings:
        with pytest.raises(TypeError):
            type_of(nothing)


def test_a_unit_has_its_number_where_there_is_one() -> None:
    assert unit_of("mm").UnitId == 5066068  # MMT
    assert unit_of("°C").UnitId == 4408652  # CEL
    known = {"%": 20529, "A": 4279632, "bar": 4342098, "deg": 17476, "°": 17476, "m": 5067858, "m/min": 12888}
    known |= {"kW": 4937556, "kg": 4933453, "m/s": 5067859, "mA": 13387, "mm/s": 4403510, "rad/s": 12865, "µm": 13384}
    known |= {"Hz": 4740186, "N": 5129559, "Nm": 20053, "V": 5655636, "W": 5723220, "min": 5065038, "ms": 4403766}
    known |= {"rpm": 5394509, "s": 5457219}
    assert {unit: unit_of(unit).UnitId for unit in known} == known  # UNECEUnitIds of OPC UA, Part 8
    assert (unit_of("counts").UnitId, unit_of("counts").DisplayName.Text) == (-1, "counts")
    assert unit_of("counts").Description.Text == "counts"


def test_the_range_of_a_point_is_what_may_be_written_else_its_limits_of_alarm() -> None:
    def limits(low: Any, high: Any, **more: Any) -> Any:
        found = range_of({"low": low, "high": high, "limits": [more] if more else []}, "force")
        return found and (found.Low, found.High)

    assert limits(1, 2) == (1, 2)
    assert limits(1, 2, name="force", minimum=-5, maximum=5) == (-5, 5)
    assert limits(1, 2, name="force", minimum=None, maximum=5) == (1, 2)
    assert limits(1, 2, name="another", minimum=-5, maximum=5) == (1, 2)
    assert limits(None, 2) is None
    assert limits(float("-inf"), 2) is None
    assert limits(1, 2, name="force", minimum=-5, maximum=float("inf")) == (1, 2)


@pytest.mark.parametrize(
    ("value", "beyond"),
    [
        (5, False),
        (-5, False),
        (5.1, True),
        (-5.1, True),
        ((1, 2), False),
        ((1, 6), True),
        ((-6, 1), True),
        ("x", False),
    ],
)
def test_a_value_is_beyond_the_limits_for_writes_of_its_own_point_alone(value: Any, beyond: bool) -> None:
    limits = [
        {"name": "force", "minimum": -5, "maximum": None},
        {"name": "force", "minimum": None, "maximum": 5},
        {"name": "another", "minimum": 1000, "maximum": 1000},
    ]
    assert is_beyond({"low": 0, "high": 1, "limits": limits}, "force", value) is beyond


def test_lists_and_times_are_as_opcua_has_them() -> None:
    numbers = variant_of((1, 2.5), KINDS.Double)
    assert (numbers.Value, numbers.VariantType) == ([1.0, 2.5], KINDS.Double)
    assert variant_of((1, 2), KINDS.Int64).Value == [1, 2]
    assert variant_of("x", KINDS.String).Value == "x"
    assert time_of(86_400.5) == datetime(1970, 1, 2, 0, 0, 0, 500_000, UTC)


def test_who_may_write_is_who_shows_a_token_where_there_are_tokens_or_others_may_come() -> None:
    secrets = {"scada": digest_of(TOKEN), "other": digest_of(TOKEN[::-1])}
    users = Users(Rules(secrets=secrets))
    known, anonymous = users.get_user(None, "scada", TOKEN), users.get_user(None)
    assert known is not None
    assert anonymous is not None
    assert users.get_user(None, "scada", "x") is None
    assert users.get_user(None, "admin", TOKEN) is None
    assert users.get_user(None, "other", TOKEN) is None
    assert Rules(secrets=secrets).refusal(known) == ""
    assert "anonymous" in Rules(secrets=secrets).refusal(anonymous)
    assert Rules().refusal(anonymous) == ""
    assert "needs a token" in Rules(is_local=False).refusal(anonymous)
    assert Rules(secrets=secrets, is_local=False).refusal(known) == ""


def test_who_says_things_openly_or_is_not_trusted_is_not_let_in() -> None:
    assert Users(Rules(is_signed=True)).get_user(None) is None
    assert Users(Rules(is_signed=True)).get_user(None, certificate=b"own") is not None
    with_tokens = Users(Rules(is_signed=True, secrets={"scada": digest_of(TOKEN)}))
    assert with_tokens.get_user(None, "scada", TOKEN) is None
    assert with_tokens.get_user(None, "scada", TOKEN, b"own") is not None
    assert Users(Rules(trusted=[])).get_user(None, certificate=b"own") is None, "no certificate is trusted"
    trusting = Users(Rules(is_signed=True, trusted=[b"own"]))
    assert trusting.get_user(None, certificate=b"another") is None
    assert trusting.get_user(None, certificate=b"own") is not None


def test_what_may_be_written_is_what_is_named() -> None:
    rules = Rules(allow=("winder/force", "drive*/speed"))
    assert [rules.may_be_written(key) for key in ("winder/force", "drive7/speed", "winder/forces", "drive7/mode")] == [
        *(True, True, False, False),
    ]


def test_a_client_that_guesses_is_slowed_down_and_each_failure_is_reported() -> None:
    failed: list[str] = []
    users = Users(Rules(secrets={"scada": digest_of(TOKEN)}), failed.append)
    users.peer = "10.0.0.1"

    def guess() -> None:
        for number in range(100):
            assert users.get_user(None, "scada", f"wrong {number}") is None

    with pytest.raises(ServiceError) as raised:
        guess()
    assert raised.value.code == CODES.BadServerTooBusy
    assert set(failed) == {"10.0.0.1"}
    assert len(failed) >= 1
    users.peer = "10.0.0.2"
    assert users.get_user(None, "scada", TOKEN) is not None
