"""The outputs of a line: files, SQLite, MQTT, OpenMetrics. None of them can slow the line.

On the loop that owns the line, an output is only offered values and events, which costs a few microseconds a cycle. It
formats, writes and sends in a thread of its own. Its queue is bounded, and dropped values are counted.
"""
