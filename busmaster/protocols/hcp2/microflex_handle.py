"""The handle of a MicroFlex drive, over HCP2."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, ClassVar, Unpack

import anyio

from busmaster.bus.handle import Action
from busmaster.bus.requester import CommandOptions, Priority, ReadOptions
from busmaster.contract.arguments import seconds
from busmaster.contract.profile import Profile
from busmaster.errors import BusClosed, BusError, VerifyFailed, WriteUnconfirmed
from busmaster.protocols._comms.handle import CommsHandle, Named
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import microflex
from busmaster.protocols.hcp2.microflex import CommandWord, StatusWord

CLEAR_WITHIN = 2.0
"""Seconds for which cancel_errors tries to clear the cancel bit, even if its caller was cancelled."""
LOOK_AGAIN = 0.02
"""Seconds between two reads of the status word."""

_NOTHING = CommandWord(0)


class MicroFlexDrive(CommsHandle):
    """A MicroFlex servo drive: nodes 0-255. Needs firmware build 5221 or newer (`check_firmware`).

        drive = MicroFlexDrive(bus, 7)
        await drive.enable()
        await drive.set_speed_reference(25.0)       # % of the application's maximum speed
        speed = await drive.speed_measured.read()

    A loss of communication does not stop the drive: assume that it keeps its last reference when the master fails.
    """

    profile: ClassVar[Profile] = microflex.PROFILE
    _read_command = hcp2.Read
    _write_command = hcp2.Write
    elements = microflex.ELEMENTS
    _definite = True
    _identity = (microflex.FIRMWARE.name,)
    _form = "an element number, 1 to 255, or a name such as speed_measured"

    position = Named(microflex.POSITION)
    axis_error = Named(microflex.AXIS_ERROR)
    following_error = Named(microflex.FOLLOWING_ERROR)
    command_word = Named(microflex.COMMAND_WORD)
    status_word = Named(microflex.STATUS_WORD)
    drive_error = Named(microflex.DRIVE_ERROR)
    demand_position = Named(microflex.DEMAND_POSITION)
    torque_reference = Named(microflex.TORQUE_REFERENCE)
    torque_demand = Named(microflex.TORQUE_DEMAND)
    speed_reference = Named(microflex.SPEED_REFERENCE)
    speed_demand = Named(microflex.SPEED_DEMAND)
    speed_measured = Named(microflex.SPEED_MEASURED)
    speed_error = Named(microflex.SPEED_ERROR)
    drive_overload = Named(microflex.DRIVE_OVERLOAD)
    motor_overload = Named(microflex.MOTOR_OVERLOAD)
    bus_voltage = Named(microflex.BUS_VOLTAGE)
    current = Named(microflex.CURRENT)
    current_u = Named(microflex.CURRENT_U)
    current_v = Named(microflex.CURRENT_V)
    hall_state = Named(microflex.HALL_STATE)
    absolute_encoder = Named(microflex.ABSOLUTE_ENCODER)
    phase_search_status = Named(microflex.PHASE_SEARCH_STATUS)
    inputs = Named(microflex.INPUTS)
    outputs = Named(microflex.OUTPUTS)
    analog_input = Named(microflex.ANALOG_INPUT)
    firmware = Named(microflex.FIRMWARE)
    temperature = Named(microflex.TEMPERATURE)

    async def status(self, **options: Unpack[ReadOptions]) -> StatusWord:
        """Return the status word."""
        return await self.status_word.read(**options)

    async def in_operation(self, **options: Unpack[ReadOptions]) -> str | None:
        """Return that the drive is enabled, from its status word; "" if it is not."""
        status = await self.status(**options)
        return "ENABLED is set in its status word" if StatusWord.ENABLED in status else ""

    async def check_firmware(self, **options: Unpack[ReadOptions]) -> int:
        """Return the drive's firmware build. Raises VerifyFailed if it is too old to have this map."""
        build = await self.firmware.read(**options)
        if build < microflex.FIRST_FIRMWARE:
            raise VerifyFailed(
                f"firmware build {build} is older than {microflex.FIRST_FIRMWARE}, the first with the element map",
                node=self.node,
                hint="update the drive's firmware",
            )
        return build

    async def enable(self, *, within: float = 0.5) -> StatusWord:
        """Enable the drive, and return its status word when it is enabled.

        Raises VerifyFailed if it is not enabled `within` this many seconds, with the cause from the status word: an
        axis error, or the hardware enable input. Raises Superseded if a `disable` overtook it.
        """
        within = seconds(within, f"{self.node.label}: within")
        await self._command(CommandWord.ENABLE)
        return await self._await_enabled(True, within, Priority.COMMAND)

    async def disable(self, *, within: float = 0.5) -> StatusWord:
        """Disable the drive before any other request on the line, and return its status word when it is disabled.

        It is retried like a read. Queued writes to this drive fail with Superseded, and a running `cancel_errors` does
        not enable it again. Raises VerifyFailed if it is still enabled after `within` seconds. If the caller is
        cancelled before it is sent, it is not sent: use a shield if it must be.
        """
        within = seconds(within, f"{self.node.label}: within")
        self.node.note_stop()  # before the write, so that a running cancel_errors no longer sets the enable bit
        await self._command(_NOTHING, priority=Priority.URGENT, stop=True)
        return await self._await_enabled(False, within, Priority.URGENT)

    async def cancel_errors(self) -> StatusWord:
        """Cancel asynchronous axis errors: set the cancel bit, keep the enable bit, and clear the cancel bit again.

        The cancel bit is cleared in any case, also if the caller is cancelled; this can take up to 2 s. If that is not
        possible, raises WriteUnconfirmed or the error of the last attempt: the drive must not stay in this state.
        Returns the status word.
        """
        stops = self.node.stops
        word = await self.command_word.read()

        async def command(cancel: CommandWord) -> None:
            """Decide again for each write: another program may have disabled the drive in the meantime."""
            # The cancel bit alone would disable a running drive. Bits that AN00129 does not define stay 0.
            kept = word & CommandWord.ENABLE if self.node.stops == stops else _NOTHING
            await self._command(kept | cancel, stops_seen=stops if kept else None)

        try:
            await command(CommandWord.CANCEL)
        except BaseException:  # a cancellation too: no error latches while the bit is set
            try:
                await _to_the_end(self._clear_cancel(command))
            except BusError:
                pass  # the first error is more useful
            raise
        await _to_the_end(self._clear_cancel(command))
        return await self.status()

    async def set_speed_reference(self, percent: float, **options: Unpack[CommandOptions]) -> None:
        """Set the speed, in % of the application's maximum.

        Raises Refused unless in speed control with the host as source.
        """
        await self.speed_reference.write(percent, **options)

    async def set_torque_reference(self, percent: float, **options: Unpack[CommandOptions]) -> None:
        """Set the torque, in % of the rated current.

        Raises Refused unless in current control with the host as source.
        """
        await self.torque_reference.write(percent, **options)

    async def _command(
        self,
        word: CommandWord,
        priority: Priority | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
    ) -> None:
        """Write the command word. It affects more than its own point, so all samples of the drive become stale."""
        command = _command(word)
        await self.node.request(command, priority=priority, stops_seen=stops_seen, stop=stop)

    async def _clear_cancel(self, command: Callable[[CommandWord], Coroutine[Any, Any, None]]) -> None:
        last: BusError | None = None
        with anyio.move_on_after(CLEAR_WITHIN):
            while True:
                try:
                    await command(_NOTHING)
                except BusClosed:  # nothing can be sent any more
                    raise
                except BusError as error:  # possibly superseded by a disable: `command` decides again
                    last = error
                else:
                    return
                await anyio.sleep(LOOK_AGAIN)
        raise last or WriteUnconfirmed(
            "the cancel bit of the command word may still be set",
            node=self.node,
            hint="clear it: errors do not latch while it is set",
        )

    async def _await_enabled(self, wanted: bool, within: float, priority: Priority) -> StatusWord:
        """Read the status word until its bit 7 has the wanted state."""
        deadline = self.node.now() + within
        while True:
            status = await self.status(priority=priority)
            if (StatusWord.ENABLED in status) is wanted:
                return status
            if self.node.now() >= deadline:
                raise VerifyFailed(
                    _why_not(status) if wanted else "still enabled",
                    node=self.node,
                    command=str(self.status_word.command),
                )
            await anyio.sleep(LOOK_AGAIN)

    _actions: ClassVar[Mapping[str, Action]] = {
        "enable": Action(
            "Enable the drive, and wait until its status word shows it.",
            enable,
            check=lambda drive: drive.node.check(_command(CommandWord.ENABLE)),
            time="within",
        ),
        "disable": Action(
            "Disable the drive ahead of all other traffic, and wait until its status word shows it.",
            disable,
            check=lambda drive: drive.node.check(_command(_NOTHING), stop=True),
            time="within",
        ),
        "reset": Action(
            "Cancel its asynchronous errors. A drive that is enabled stays enabled.",
            cancel_errors,
            check=lambda drive: drive.node.check(_command(CommandWord.CANCEL)),
        ),
    }


def _command(word: CommandWord) -> hcp2.Write:
    """Return the write of a command word. It may be repeated: the bits are levels."""
    return hcp2.Write(microflex.COMMAND_WORD.number, (word,), idempotent=True)


async def _to_the_end(work: Coroutine[Any, Any, None]) -> None:
    """Run `work` to its end, even if the caller is cancelled: the caller gets its CancelledError afterwards.

    It runs in a task of its own, because a scope's shield stops anyio's cancellation, but not `Task.cancel()`.
    """
    task = asyncio.ensure_future(work)
    cancelled: asyncio.CancelledError | None = None
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.wait([task])
            except asyncio.CancelledError as error:
                cancelled = error
    if cancelled is not None:
        await asyncio.gather(task, return_exceptions=True)
        raise cancelled
    task.result()


def _why_not(status: StatusWord) -> str:
    """Return why a drive did not enable, as far as its status word shows it."""
    reasons = []
    if StatusWord.ASYNCHRONOUS_ERROR in status:
        reasons.append("it has an error (see axis_error and drive_error)")
    if StatusWord.STOP_INPUT in status:
        reasons.append("its error or stop input is active")
    if StatusWord.HARDWARE_ENABLE not in status:
        reasons.append("its hardware enable input is not active")
    return f"not enabled: {', '.join(reasons) or 'its status word gives no reason'}"
