"""What an endpoint is, and the one that a URL names (``mavlink/urls.py`` has the table)."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

from nff_companion.mavlink.names import address_of
from nff_companion.mavlink.urls import parse

Sender = tuple[str, int] | None  # address and port; None where there can be but one


class Endpoint(Protocol):
    """A non-blocking byte pipe."""

    url: str
    datagrams: bool  # each item received is a datagram; otherwise a piece of a stream

    @property
    def connected(self) -> bool:
        """Whether there is somebody to send to."""

    def fileno(self) -> int:
        """File descriptor to wait on."""

    def receive(self) -> list[tuple[bytes, Sender]]:
        """All that has arrived, one item a datagram or read, with its sender. Raises EndpointError: port lost."""

    def answer(self, sender: Sender) -> None:
        """From now on send to ``sender``, where a choice exists (``udpin``)."""

    def send(self, data: bytes) -> bool:
        """Send the frame, at once or after what waits; False when dropped (nobody to send to, or no room)."""

    def flush(self) -> None:
        """Send of what waits as much as the line takes now."""

    def close(self) -> None:
        """Close; afterwards nothing else may be called."""


def open_endpoint(url: str, baud: int | None = None, *, wait: bool = True, address: str | None = None) -> Endpoint:
    """Open the endpoint, a serial port with ``baud`` of its list; ``wait`` for a connection to be made.

    ``address`` is what the URL's host name was found to mean; without it the name is looked up here, which may block.
    Raises ConfigError, EndpointError.
    """
    parsed = parse(url)
    if parsed.kind == "serial":
        from nff_companion.mavlink.endpoints.serial_port import SerialPort

        return SerialPort(url, parsed if baud is None else replace(parsed, number=baud))
    parsed = replace(parsed, host=address or address_of(parsed.host))
    if parsed.kind in ("udpin", "udpout"):
        from nff_companion.mavlink.endpoints.udp import Udp

        return Udp(url, parsed)
    if parsed.kind == "tcp":
        from nff_companion.mavlink.endpoints.tcp import Tcp

        return Tcp(url, parsed, wait=wait)
    from nff_companion.mavlink.endpoints.tcp_server import TcpServer

    return TcpServer(url, parsed)
