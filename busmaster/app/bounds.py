"""The bounds of all content of a file and all requests of a client. Input beyond a bound is rejected with its name.

Each bound is declared here, or in `busmaster/contract/bounds.py` if the library needs it too, and nowhere else. The
page docs/reference/bounds.md is made of both: a line `# Title` begins a section of that page, and the text below a name
is its row. Times are in seconds.
"""

from __future__ import annotations

# Files

LONGEST_LINE_RECORD = 1 << 14
"""Bytes of a `NAME.line` file in the folder of the sockets."""
MOST_NESTED = 16
"""Brackets within brackets of a TOML file, and names in one dotted key. The reader needs a call for each level, so
without a bound a file could exhaust the stack of the program that reads it."""
LONGEST_TEXT = 1 << 15
"""Characters of one text in a TOML file: more than the longest MQTT topic."""
LONGEST_WORD = 200
"""Characters of one number, or of one key without quotes, in a TOML file."""
LONGEST_TITLE = 200
"""Characters of a line's `title`: it is shown in every view and list."""
LONGEST_TOPIC = 65535 // 3
"""Characters of an MQTT topic: the most that it can have where each of them takes three bytes."""
LARGEST_WHOLE = 1_000_000
"""The largest whole number, where the key has no other range."""
MOST_NAMES = 1000
"""Names that one name with ranges may stand for, all its ranges together: `a1-10b1-10` stands for 100."""
LONGEST_TIMING = 10.0
"""Seconds of each reply time that a file may set: a larger number is meant in milliseconds."""
LONGEST_SAFE_STATE = 60.0
"""Seconds in which the writes of `[safe]` must be sent and confirmed."""
MOST_BUFFERED = 1_000_000
"""Values that wait for an output in memory."""
MOST_SPILLED = 100_000_000
"""Values that wait for an output on disk."""
SHORTEST_TOKEN = 16
"""Characters of a token, at least: a shorter one can be guessed."""

# Clients of the service

LONGEST_REQUEST = 1 << 16
"""Bytes of one message of a client: the time for parsing one delays the line."""
READ_AT_ONCE = 512
"""Bytes of one connection, also to the web page, that are read in one turn of the loop: two or three requests, or
eighty of the smallest frames."""
MOST_PARTS = 1 << 13
"""Values in one message of a client: of as many bytes, those of many small ones take longest to understand."""
LONGEST_ANSWER = 1 << 20
"""Bytes of one message to a client."""
HELLO_WITHIN = 10.0
"""Seconds in which the first message of a client must arrive."""
SEND_WITHIN = 20.0
"""Seconds in which the other end must take a message: a connection that does not is closed."""
MOST_CLIENTS = 64
"""Clients of all roles at a time, without those in reserved places."""
RESERVED_FOR_WRITERS = 8
"""Further places for clients of role `write`: no client of another role can take them."""
RESERVED_FOR_ADMINS = 8
"""Further places for clients of role `admin`: the owner's user and root, unless the line's file has another role."""
RESERVED_FOR_SAFE = 2
"""Further places for clients that only send the safe state (`busmaster safe`). One more closes the oldest of them that
has not requested it."""
MOST_STRANGERS = 64
"""Connections from which no first message has arrived: one more closes the oldest of the user or the address that has
most of them."""
FREE_CONNECTIONS = 128
"""Connections of a peer that are let in one behind the other: a process by the Unix socket, or an address by TCP."""
CONNECTIONS_A_SECOND = 20
"""Connections of a peer, from then on, that are let in within a second: the others wait before their login is read."""
MOST_DELAYED = 32
"""Connections of a peer that wait so: one more is closed at once."""
MOST_CONNECTING_PEERS = 1024
"""Peers whose connections are counted: one more has the one forgotten whose last connection is oldest."""
MOST_FRAMES = 50
"""Frames of a client within a second that are not a whole message: pings, pongs and pieces of messages. Each takes as
long to understand as a request, and no client needs so many: the connection of one that sends more is closed."""
MOST_REQUESTS = 256
"""Requests of one client that have not been answered."""
MOST_URGENT = 16
"""Urgent requests, and the safe state, that are taken beyond those."""
MOST_UNDER_WAY = MOST_REQUESTS // 2
"""Requests of one client, none of them urgent, that it has sent and that are not answered: the others wait in the
client. As many again may have been given up by it, and still be known to the owner."""
MOST_HOLDS = 32
"""Exclusive sequences of one client that are not over."""
MOST_UNREAD = 256
"""Messages of streams that one client has not read: beyond it the oldest is dropped, and counted."""
MOST_WAITING = MOST_UNREAD + 2 * MOST_REQUESTS
"""Messages for one client that are not sent yet: beyond it nothing more is read from the client."""
MOST_CHECKED = 64
"""Writes of one question whether the line would take them."""
MOST_NODES = 1024
"""Nodes that one client names."""
MOST_SYNC_READS = 64
"""Sync reads that a client names for one node: more than any kind of node needs."""
MOST_STREAMS = 256
"""Streams of one client: an interface follows each poll group of a line by a stream of its own."""
MOST_POLLED = 32
"""Poll groups of one client."""
MOST_POLLED_POINTS = 1000
"""Points of one poll group of a client."""
MOST_PLANNED_READS = 200
"""Reads of all groups that a client has planned beside those that run."""
MOST_PLANNED_GROUPS = 200
"""Poll groups of a line, with those of the client, beyond which no plan is calculated for a client."""
LONGEST_REPLY = 5.0
"""Seconds for which a client may have the line wait for a reply: nothing else is sent meanwhile."""
LONGEST_WAIT = 86_400.0
"""Seconds of `start_within` and `finish_within` of a client's request: a day."""
FARTHEST_REQUESTED = 60.0
"""Seconds by which the `requested` of a client may be ahead of the owner's clock. More is from another clock."""

# Logins by token or password, at whatever interface

FREE_LOGINS = 5
"""Failed logins of a peer after which nothing happens."""
SHORTEST_LOGIN_PAUSE = 1.0
"""Seconds after the next failed login in which the peer's logins are not checked; twice as long after each more."""
LONGEST_LOGIN_PAUSE = 30.0
"""Seconds of that pause, at most."""
LOGINS_FORGOTTEN = 600.0
"""Seconds without a failed login after which those before are forgotten."""
MOST_LOGIN_PEERS = 1024
"""Peers whose logins are remembered: one more has the one forgotten whose last login is oldest."""
MOST_REPORTED = 100
"""Peers that are counted apart between two reports of failed logins."""

# Commands, by whatever interface

LONGEST_COMMAND = 4096
"""Bytes of a command as text, and of the body of a request to `busmaster web`: it holds one value, or a few."""
LONGEST_ID = 100
"""Characters of a command's id."""
LARGEST_VALUE = 1e15
"""The largest value: no quantity is larger, and no protocol can send more."""
MOST_AT_ONCE = 16
"""Commands of one interface that are being written at a time."""
AUDIT_WITHIN = 5.0
"""Seconds for an audit entry to become durable with `audit = "strict"`; then the client gets WriteUnconfirmed."""
MOST_COMMANDS = 100
"""MQTT commands that wait for their turn, and refusals that wait to be answered: more are only counted."""
LONGEST_NAME = 256
"""Characters of a point's name in the reply to an MQTT command: a longer name is omitted from the reply."""
LONGEST_SENDER = 100
"""Characters of the name that the sender of an MQTT command gives itself."""

# `busmaster web`

LONGEST_PAGE_MESSAGE = 1024
"""Bytes of one message of a page."""
MOST_PAGES = 64
"""Pages that follow the line at a time."""
MOST_PAGE_CONNECTIONS = 512
"""Connections at a time; fewer where the process may have fewer descriptors (`ulimit -n`, less 128). One more closes
the connection that has waited longest without a whole request, and that is reported once a minute."""
REQUEST_WITHIN = 10.0
"""Seconds in which a connection must send a whole request, with its body, from its beginning or from its last reply."""
MOST_SAMPLES = 10_000
"""Samples of one reply of /api/history: of more, each part of the range is summed up."""
HISTORY_WITHIN = 10.0
"""Seconds for reading the history of one request: a longer range is refused with 503."""
MOST_HISTORY = 16
"""Requests for history that are read or wait to be read: one more is refused with 503."""
HISTORY_THREADS = 2
"""Requests for history that are read at a time."""

# Metrics

LONGEST_SCRAPE = 8192
"""Bytes of the head of a request for the metrics."""
MOST_SILENT = 256
"""Connections without a whole request: one more closes the oldest of them."""
MOST_ASKING = 400
"""Requests that are answered at a time: more are answered with 503."""

# `busmaster modbus-tcp`

MOST_GATEWAY_CONNECTIONS = 128
"""Connections at a time. One more closes another one, or is refused."""
MOST_GATEWAY_PER_PEER = 32
"""Connections of one address: one more is refused."""
MOST_GATEWAY_ON_LINE = 4
"""Pass-through requests of one address on the line at a time: further ones wait."""
MOST_GATEWAY_UNREAD = 4096
"""Bytes of requests, and of replies, that are held for one connection: TCP makes the client wait for the rest."""
GATEWAY_SEND_WITHIN = 10.0
"""Seconds in which a client must read its replies: otherwise its connection is closed."""

# `busmaster opcua`

MOST_CONNECTIONS = 100
"""Connections at a time."""
MOST_SUBSCRIPTIONS = 500
"""Subscriptions at a time, of all clients together."""
MOST_SESSION_SUBSCRIPTIONS = 50
"""Subscriptions of one session."""
MOST_ITEMS = 20_000
"""Monitored items at a time, of all clients together."""
MOST_SESSION_ITEMS = 5_000
"""Monitored items of one session."""
MOST_OPERATIONS = 5_000
"""Nodes or items of one request."""
LONGEST_ITEM_QUEUE = 10
"""Values of one monitored item that wait to be published: the oldest is dropped."""
MOST_UNACKNOWLEDGED = 10
"""Messages of a subscription that are kept until the client acknowledges them."""
SHORTEST_PUBLISHING = 0.05
"""Seconds from one message of a subscription to the next, at least."""
LONGEST_PUBLISHING = 60.0
"""Seconds from one message of a subscription to the next, at most."""
LONGEST_OPCUA_CHUNK = 65_535
"""Bytes of one chunk of a message: a connection that announces more is closed."""
LONGEST_OPCUA_HELLO = 8_192
"""Bytes of the first message of a connection."""
LONGEST_OPCUA_REQUEST = 1 << 20
"""Bytes of one message of a client with a session; of one without a session, `LONGEST_OPCUA_CHUNK`."""
LONGEST_SESSION_PAUSE = 120.0
"""Seconds without a request after which a session is closed, at most."""
SESSION_WITHIN = 10.0
"""Seconds after which a connection without a session is closed, and at most twice as many."""
MOST_WAITING_WRITES = 100
"""Write requests of one connection that have not been answered."""
MOST_SHOWN_POINTS = 20_000
"""Points that are shown, with those that the line no longer has: clients may have subscribed to them."""

__all__ = [name for name in sorted(globals()) if name.isupper()]
