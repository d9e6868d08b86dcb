"""The old name of `busmaster.contract.frames`: importing it is an error that names the new one."""

raise ImportError(
    "busmaster.capture.frames has moved to busmaster.contract.frames, with Dialect; see docs/upgrading.md",
    name=__name__,
)
