"""The small services of the protocol, one file each."""
