"""What a protocol and the arbiter agree on: exchanges, their times, and the profile of a protocol."""
