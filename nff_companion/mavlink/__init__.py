"""Bytes to messages and back: endpoints, framing, time. Nothing here knows the vehicle."""
