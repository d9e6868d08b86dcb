"""The reply times of a node in messages, and the limits of those that a client sets."""

from __future__ import annotations

from busmaster import InvalidCommand, ReplyTiming, Timings
from busmaster.app.bounds import LONGEST_REPLY
from busmaster.app.service.fields import ReplyTimesForm, TimingForm, TimingsForm
from busmaster.app.service.typed import UNSET, UnsetType
from busmaster.ext import Learned, Profile, documented

STEPS = ("read", "write", "packet")


def encode_timings(timings: Timings | Learned | None) -> ReplyTimesForm | None:
    """Return the reply times of a node in the form of a message."""
    if timings is None:
        return None
    if isinstance(timings, Learned):
        return ReplyTimesForm(learned=None if timings.document is None else _encode_steps(timings.document))
    steps = _encode_steps(timings)
    return ReplyTimesForm(steps.read, steps.write, steps.packet)


def _encode_steps(timings: Timings) -> TimingsForm:
    return TimingsForm(*(_encode_timing(getattr(timings, step)) for step in STEPS))


def _encode_timing(timing: ReplyTiming) -> TimingForm:
    return TimingForm(
        timing.late_after,
        timing.window,
        timing.max_reply_delay,
        timing.inter_byte_timeout,
        timing.driver_release_time,
        timing.silence,
    )


def timings_of(form: ReplyTimesForm | None) -> Timings | Learned | None:
    """Return the reply times in a message. Raises InvalidCommand for invalid ones."""
    if form is None:
        return None
    if not isinstance(form.learned, UnsetType):
        if any(getattr(form, step) is not UNSET for step in STEPS):
            raise InvalidCommand("invalid reply times: learned excludes read, write and packet")
        return Learned(None if form.learned is None else _timings_of(form.learned))
    steps = [step for step in STEPS if getattr(form, step) is UNSET]
    if steps:
        raise InvalidCommand(f"invalid reply times: {' and '.join(steps)} missing")
    return _timings_of(form)


def _timings_of(form: ReplyTimesForm | TimingsForm) -> Timings:
    return Timings(*(_timing_of(getattr(form, step)) for step in STEPS))


def _timing_of(form: TimingForm) -> ReplyTiming:
    longest = max(form.max_reply_delay, form.inter_byte_timeout, form.driver_release_time, form.silence or 0.0)
    if longest > LONGEST_REPLY:
        raise InvalidCommand(f"a program may have the line wait {LONGEST_REPLY:g} s for a reply, and no longer")
    return ReplyTiming(
        form.late_after,
        form.window,
        form.max_reply_delay,
        form.inter_byte_timeout,
        form.driver_release_time,
        form.silence,
    )


def check_within(times: Timings | Learned | None, profile: Profile, address: int) -> None:
    """Raise InvalidCommand for reply times that keep the line for longer than those of the protocol's document.

    The line sends nothing else while it waits for a reply.
    """
    times, limits = documented(times), profile.timings
    for step in () if times is None else STEPS:
        for name in ("max_reply_delay", "inter_byte_timeout", "driver_release_time", "silence"):
            requested, limit = getattr(getattr(times, step), name), getattr(getattr(limits, step), name)
            if requested is not None and requested > (
                getattr(limits, step).max_reply_delay if limit is None else limit
            ):
                raise InvalidCommand(
                    f"{profile.label(address)}: {name} of {requested:g} s is longer than that of {profile.name}: "
                    "set it for the node in the line's file, or use a program with the role admin"
                )
