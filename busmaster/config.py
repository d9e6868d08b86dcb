"""The old name of `busmaster.app.config` and `busmaster.app.line`: importing it is an error that names them."""

raise ImportError(
    "busmaster.config has moved: open_line is in busmaster, ConfiguredLine and check are in busmaster.app.line, "
    "FileError, load and emulated_line in busmaster.app.config; see docs/upgrading.md",
    name=__name__,
)
