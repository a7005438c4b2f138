"""Host names, looked up beside the loop: a resolver that does not answer must hold up nobody."""

from __future__ import annotations

import ipaddress
import socket
import threading

from nff_companion.errors import EndpointError


def literal(host: str) -> bool:
    """Whether ``host`` is an IPv4 address and needs no look-up."""
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        return False
    return True


def address_of(host: str) -> str:
    """IPv4 address of a host. Blocks while a name is looked up. Raises EndpointError when there is none."""
    if literal(host):
        return host
    try:
        found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise EndpointError(f"host {host} is not found: {error}; give its address, or see the name service") from error
    return str(found[0][4][0])


class Lookup:
    """One look-up of one host, in a thread of its own unless it is an address already."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.beside = not literal(host)  # of the loop
        self._address = None if self.beside else host
        self._error: EndpointError | None = None
        if self.beside:
            threading.Thread(target=self._run, name=f"look up {host}", daemon=True).start()

    def _run(self) -> None:
        try:
            self._address = address_of(self.host)
        except EndpointError as error:
            self._error = error

    def address(self) -> str | None:
        """The address; None while it is not known. Raises EndpointError when the host is not found."""
        if self._error is not None:
            raise self._error
        return self._address
