"""All endpoints of one daemon: opened, waited on, opened again when lost. Messages in, messages out."""

from __future__ import annotations

import logging
import select
import struct
from dataclasses import dataclass, field

import numpy as np

from nff_companion.errors import EndpointError
from nff_companion.mavlink.codec import Codec, Message
from nff_companion.mavlink.endpoint import Endpoint, open_endpoint, parse

log = logging.getLogger("nff")

_RECONNECT_S = 1.0
_BAUD_SILENT_S = 2.0  # without one good frame: the next baud of the list is tried


@dataclass(slots=True)
class _Port:
    url: str
    codec: Codec
    bauds: tuple[int, ...] = ()
    endpoint: Endpoint | None = None
    baud_index: int = 0
    next_try_s: float = -np.inf
    opened_s: float = -np.inf
    descriptor: int = -1
    heard: bool = False
    complained: str = field(default="")


class Hub:
    """Ports by the order of their URLs. ``now_s`` is any monotonic clock."""

    def __init__(self, urls: list[str], system: int, component: int, poll: select.poll, now_s: float) -> None:
        """Open all. Raises ConfigError for a bad URL, EndpointError when not one can be opened."""
        self._poll = poll
        self.unsendable = 0
        self._ports = [_Port(url, Codec(system, component), parse(url).bauds) for url in urls]
        opened = [self._open(port, now_s, wait=True) for port in self._ports]
        errors = [error for error in opened if error is not None]
        if len(errors) == len(self._ports):
            self.close()
            raise errors[0]
        for error in errors:
            log.error("%s; trying again every %.0f s", error, _RECONNECT_S)

    @property
    def bad_frames(self) -> int:
        """Frames of all ports that did not parse."""
        return sum(port.codec.bad_frames for port in self._ports)

    def set_system(self, system: int) -> None:
        """Speak as this system."""
        for port in self._ports:
            port.codec.system = system

    def owns(self, descriptor: int) -> bool:
        """Whether a file descriptor is one of ours."""
        return any(port.descriptor == descriptor for port in self._ports)

    def read(self, descriptor: int, now_s: float) -> list[tuple[Message, int]]:
        """Messages that have arrived at a descriptor, with the index of their port."""
        for index, port in enumerate(self._ports):
            if port.descriptor != descriptor or port.endpoint is None:
                continue
            out: list[tuple[Message, int]] = []
            try:
                for data in port.endpoint.receive():
                    out += [(message, index) for message in port.codec.parse(data)]
            except EndpointError as error:
                self._drop(port, error, now_s)
            port.heard = port.heard or bool(out)
            return out
        return []

    def send(self, message: Message, index: int | None, now_s: float) -> None:
        """Send through one port, or through all."""
        for port in self._ports if index is None else [self._ports[index]]:
            if port.endpoint is None:
                continue
            try:
                port.endpoint.send(port.codec.pack(message))
            except EndpointError as error:
                self._drop(port, error, now_s)
            except struct.error as error:
                # A value that its field cannot hold: said, counted, not sent.
                self.unsendable += 1
                log.error("%s cannot be packed: %s", message.get_type(), error)

    def maintain(self, now_s: float) -> None:
        """Open again what was lost; try the next baud of a serial port that says nothing we understand."""
        for port in self._ports:
            if port.endpoint is None and now_s >= port.next_try_s:
                error = self._open(port, now_s)
                if error is not None and str(error) != port.complained:
                    port.complained = str(error)
                    log.error("%s", error)
            elif len(port.bauds) > 1 and not port.heard and now_s - port.opened_s > _BAUD_SILENT_S:
                port.baud_index = (port.baud_index + 1) % len(port.bauds)
                self._drop(port, EndpointError(f"{port.url}: nothing readable at this baud"), now_s, wait_s=0.0)

    def close(self) -> None:
        """Close all."""
        for port in self._ports:
            self._forget(port)

    # -- one port -----------------------------------------------------------------------------------------------

    def _open(self, port: _Port, now_s: float, *, wait: bool = False) -> EndpointError | None:
        port.next_try_s = now_s + _RECONNECT_S
        try:
            port.endpoint = open_endpoint(port.url, baud=port.bauds[port.baud_index] if port.bauds else None, wait=wait)
        except EndpointError as error:
            return error
        port.descriptor, port.opened_s, port.heard = port.endpoint.fileno(), now_s, False
        if port.complained:
            log.warning("%s: open again", port.url)
        port.complained = ""
        self._poll.register(port.descriptor, select.POLLIN)
        return None

    def _drop(self, port: _Port, error: EndpointError, now_s: float, wait_s: float = _RECONNECT_S) -> None:
        log.error("%s; trying again", error)
        port.complained = str(error)
        self._forget(port)
        port.next_try_s = now_s + wait_s

    def _forget(self, port: _Port) -> None:
        if port.endpoint is not None:
            self._poll.unregister(port.descriptor)
            port.endpoint.close()
        port.endpoint, port.descriptor = None, -1
