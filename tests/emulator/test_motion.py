"""The motion models: exact, told the time, never running back."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.emulator.motion import Axis, Motion, Ramp


def test_a_ramp_reaches_its_speed_and_integrates_exactly() -> None:
    ramp = Ramp(rate=10.0, target=20.0)
    ramp.advance(5.0)  # its time begins
    ramp.advance(7.0)
    assert (ramp.speed, ramp.position) == (20.0, 20.0)
    ramp.advance(8.0)
    assert ramp.position == 40.0
    ramp.target = -20.0
    ramp.advance(10.0)
    assert (ramp.speed, ramp.position) == (0.0, 60.0)


@given(st.lists(st.floats(0, 2), min_size=1, max_size=20), st.floats(-50, 50))
@settings(max_examples=100)
def test_how_often_a_ramp_is_asked_makes_no_difference(steps: list[float], target: float) -> None:
    often, once = Ramp(rate=10.0, target=target), Ramp(rate=10.0, target=target)
    often.advance(0.0)
    once.advance(0.0)
    now = 0.0
    for step in steps:
        now += step
        often.advance(now)
    once.advance(now)
    assert often.position == pytest.approx(once.position, abs=1e-6)
    assert often.speed == pytest.approx(once.speed, abs=1e-6)


def test_an_axis_moves_to_its_target_and_is_idle_there() -> None:
    axis = Axis()
    axis.speed = 10.0
    axis.move(-5.0, 1.0)
    assert axis.position(1.25) == pytest.approx(-2.5)
    assert axis.velocity(1.3) == -10
    assert not axis.idle(1.4)
    assert axis.position(9.0) == -5
    assert axis.idle(9.0)
    axis.move(-5.0, 9.0)
    assert axis.idle(9.0)
    axis.move(0.0, 10.0, Motion.HOME)
    assert axis.motion is Motion.HOME
    assert axis.position(11.0) == 0


def test_an_axis_that_jogs_can_be_stopped() -> None:
    axis = Axis(acceleration=1e9)
    axis.jog(10.0, 0.0)
    axis.position(0.0)
    assert axis.position(1.0) == pytest.approx(10)
    axis.stop(1.0)
    assert axis.position(5.0) == pytest.approx(10)
    assert axis.idle(5.0)


def test_an_axis_swings_to_and_fro() -> None:
    axis = Axis()
    axis.swing(100.0, 8.0, 0.0, 0.0)
    assert axis.position(2.0) == pytest.approx(100)
    assert axis.velocity(2.0) == pytest.approx(0, abs=1e-9)
    assert axis.position(6.0) == pytest.approx(-100)
    assert axis.velocity(4.0) == pytest.approx(-100 * math.tau / 8)
    axis.jog(0.0, 4.0)
    assert axis.motion is Motion.JOG


def test_an_axis_that_is_placed_is_idle_there_whatever_it_did_before() -> None:
    jogging, moving, swinging = Axis(), Axis(), Axis()
    jogging.jog(10.0, 0.0)
    moving.move(50.0, 0.0)
    swinging.swing(9.0, 1.0, 0.0, 0.0)
    for axis in (jogging, moving, swinging):
        axis.place(7.0, 1.0)
        assert axis.idle(1.0)
        assert axis.velocity(1.0) == 0
        assert axis.position(100.0) == 7.0


def test_an_axis_follows_from_where_it_is_and_never_arrives() -> None:
    axis = Axis(acceleration=10.0)
    axis.place(5.0, 0.0)
    axis.move(6.0, 0.0)
    axis.stop(0.0)
    axis.follow(-20.0, 0.0)
    assert axis.motion is Motion.FOLLOW
    assert axis.velocity(1.0) == pytest.approx(-10.0)
    assert axis.position(2.0) == pytest.approx(5.0 - 20.0)
    assert axis.position(3.0) == pytest.approx(5.0 - 40.0)
    assert not axis.idle(1000.0)


def test_a_jog_interrupts_a_move_for_good() -> None:
    axis = Axis(acceleration=1e9)
    axis.speed = 10.0
    axis.move(100.0, 0.0)
    axis.jog(20.0, 1.0)
    assert axis.position(11.0) == pytest.approx(210.0)
    assert axis.motion is Motion.JOG


def test_a_swing_begins_at_its_phase() -> None:
    axis = Axis()
    axis.swing(100.0, 8.0, 0.25, 0.0)
    assert axis.position(0.0) == pytest.approx(100)
    assert axis.velocity(0.0) == pytest.approx(0, abs=1e-9)
    assert axis.position(2.0) == pytest.approx(0, abs=1e-9)
    axis.stop(4.0)
    assert axis.position(9.0) == pytest.approx(-100)


def test_a_move_without_speed_goes_on_for_very_long() -> None:
    axis = Axis()
    axis.speed = 0.0
    axis.move(1.0, 0.0)
    assert 0 < axis.position(1.0) < 1e-3
    assert not axis.idle(1.0)
    axis.place(0.0, 1.0)
    axis.speed = -10.0
    axis.move(1.0, 1.0)
    assert axis.position(1.05) == pytest.approx(0.5)


def test_after_a_swing_an_axis_begins_from_standstill() -> None:
    axis = Axis(acceleration=10.0)
    axis.jog(10.0, 0.0)
    axis.position(0.0)
    axis.swing(1.0, 1.0, 0.0, 1.0)
    axis.jog(5.0, 2.0)
    assert axis.velocity(2.0) == 0
    assert axis.velocity(3.0) == 5.0
