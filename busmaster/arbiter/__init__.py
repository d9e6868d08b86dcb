"""The pure heart: no asyncio, no clock, no I/O. It is told the time and the bytes, and says what to send."""
