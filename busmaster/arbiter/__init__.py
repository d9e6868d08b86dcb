"""The state of one line, without asyncio, clock or I/O: its caller passes time and bytes, and sends the output."""
