"""Endpoint URLs, in both families in use: ``udpin:host:port`` and ``udpin://host:port``.

| URL | meaning |
|---|---|
| ``udpin:host:port`` | bind, answer the vehicle that is heard there |
| ``udpout:host:port`` | send to host:port, receive its answers |
| ``tcp:host:port``, ``tcpout:`` | connect |
| ``tcpin:host:port`` | listen, one client at a time |
| ``/dev/ttyAMA0:921600``, ``serial:/dev/ttyAMA0:921600`` | serial port and baud |
| ``/dev/ttyAMA0:921600,460800`` | the same; the next baud is tried while nothing readable arrives |
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from nff_companion.errors import ConfigError

_BAUD_MIN = 300
KINDS = ("udpin", "udpout", "tcp", "tcpin", "serial")


@dataclass(frozen=True)
class Url:
    """A parsed endpoint URL; ``number`` is the port or the (first) baud rate, ``bauds`` all of them."""

    kind: str
    host: str
    number: int
    bauds: tuple[int, ...] = ()


def parse(url: str) -> Url:
    """Parse an endpoint URL of either family. Raises ConfigError with the form expected."""
    text = url.strip()
    if text.startswith("/"):
        text = f"serial:{text}"
    match = re.fullmatch(r"([a-z]+):(?://)?([^\x00-\x20]+):([0-9]{1,9}(?:,[0-9]{1,9})*)", text)
    if match is None:
        raise ConfigError(
            f"endpoint {url[:100]!r} is not of the form kind:host:port or /dev/tty:baud; kinds: {', '.join(KINDS)}"
        )
    kind, host = match.group(1), match.group(2)
    numbers = tuple(int(text) for text in match.group(3).split(","))
    kind = {"tcpout": "tcp", "udp": "udpin"}.get(kind, kind)
    if kind not in KINDS:
        raise ConfigError(f"endpoint {url!r}: kind {kind!r} is unknown; choose one of {', '.join(KINDS)}")
    if kind == "serial":
        if min(numbers) < _BAUD_MIN:
            raise ConfigError(f"endpoint {url!r}: {match.group(3)} is no baud rate of {_BAUD_MIN} or more")
        return Url(kind, host, numbers[0], numbers)
    if len(numbers) > 1 or not 0 < numbers[0] < 65536:
        raise ConfigError(f"endpoint {url!r}: {match.group(3)} is not one port between 1 and 65535")
    if ":" in host:
        raise ConfigError(f"endpoint {url!r}: {host} is an IPv6 address, only IPv4 is spoken here; give that or a name")
    return Url(kind, host, numbers[0])
