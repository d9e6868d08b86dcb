"""Where the values of a line go: files, SQLite, MQTT, OpenMetrics. None of them can slow the line.

On the loop that owns the line an output is only offered what has passed, which costs a few microseconds a cycle. It
formats, writes and sends in a thread of its own. What it has not yet taken is bounded; what is dropped is counted.
"""
