"""The contract between protocols and the arbiter: exchanges, their times, and the profile of a protocol."""
