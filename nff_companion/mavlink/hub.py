"""All endpoints of one daemon: opened, waited on, opened again when lost. Messages in, messages out."""

from __future__ import annotations

import logging
import select
import struct
from dataclasses import dataclass

import numpy as np

from nff_companion.errors import EndpointError
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.endpoint import Endpoint, Sender, open_endpoint
from nff_companion.mavlink.names import Lookup
from nff_companion.mavlink.urls import parse

log = logging.getLogger("nff")

_RECONNECT_S = 1.0
_BAUD_SILENT_S = 2.0  # without one good frame: the next baud of the list is tried


@dataclass(slots=True)
class _Port:
    url: str
    codec: Codec
    bauds: tuple[int, ...] = ()
    endpoint: Endpoint | None = None
    lookup: Lookup | None = None  # under way: the port waits for it
    baud_index: int = 0
    next_try_s: float = -np.inf
    opened_s: float = -np.inf
    descriptor: int = -1
    heard: bool = False
    sender: Sender = None  # who is answered; the client whose stream the codec is in
    has_vehicle: bool = False  # the adopted one was heard here since: nobody else is answered
    complained: str = ""
    dropped: int = 0


class Hub:
    """Ports by the order of their URLs. ``now_s`` is any monotonic clock. Nothing here waits for anybody.

    Who is answered on a ``udpin`` port: the last sender of a frame that parsed; once the adopted vehicle was heard
    there, the last one that sent a frame of that vehicle's autopilot.
    """

    def __init__(self, urls: list[str], system: int, component: int, poll: select.poll, now_s: float) -> None:
        """Open all; a host name is looked up meanwhile, and its port opened by ``maintain``.

        Raises ConfigError for a bad URL, EndpointError when not one can be opened.
        """
        self._poll = poll
        self.unsendable = 0
        self._vehicle: int | None = None
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

    @property
    def dropped(self) -> int:
        """Frames of all ports that were to be sent to somebody and found no room."""
        return sum(port.dropped for port in self._ports)

    @property
    def dropped_by_port(self) -> dict[str, int]:
        """The same, by URL."""
        return {port.url: port.dropped for port in self._ports}

    def set_system(self, system: int) -> None:
        """Speak as this system."""
        for port in self._ports:
            port.codec.system = system

    def adopt(self, system: int | None) -> None:
        """Keep the ports where this system's autopilot is heard to it alone; None: to nobody."""
        self._vehicle = system
        for port in self._ports:
            port.has_vehicle = False  # whoever is answered stays so until the vehicle is heard

    def owns(self, descriptor: int) -> bool:
        """Whether a file descriptor is one of ours."""
        return any(port.descriptor == descriptor for port in self._ports)

    def read(self, descriptor: int, now_s: float) -> list[tuple[Message, int]]:
        """Messages that have arrived at a descriptor, with the index of their port."""
        for index, port in enumerate(self._ports):
            if port.descriptor != descriptor or port.endpoint is None:
                continue
            try:
                messages = self._receive(port, port.endpoint)
            except EndpointError as error:
                self._drop(port, error, now_s)
                return []
            port.heard = port.heard or bool(messages)
            return [(message, index) for message in messages]
        return []

    def send(self, message: Message, index: int | None, now_s: float) -> None:
        """Send through one port, or through all."""
        for port in self._ports if index is None else [self._ports[index]]:
            if port.endpoint is None or not port.endpoint.connected:
                continue
            try:
                if not port.endpoint.send(port.codec.pack(message)):
                    port.dropped += 1
            except EndpointError as error:
                self._drop(port, error, now_s)
            except (struct.error, OverflowError) as error:
                # A value that its field cannot hold: said, counted, not sent.
                self.unsendable += 1
                log.error("%s cannot be packed: %s", message.get_type(), error)

    def maintain(self, now_s: float) -> None:
        """Open again what was lost, send what waits; try the next baud where nothing arrives that we understand."""
        for port in self._ports:
            if port.endpoint is None:
                if port.lookup is None and now_s < port.next_try_s:
                    continue
                error = self._open(port, now_s)
                if error is not None and str(error) != port.complained:
                    port.complained = str(error)
                    log.error("%s", error)
            elif len(port.bauds) > 1 and not port.heard and now_s - port.opened_s > _BAUD_SILENT_S:
                port.baud_index = (port.baud_index + 1) % len(port.bauds)
                self._drop(port, EndpointError(f"{port.url}: nothing readable at this baud"), now_s, wait_s=0.0)
            else:
                try:
                    port.endpoint.flush()
                except EndpointError as error:
                    self._drop(port, error, now_s)

    def close(self) -> None:
        """Close all."""
        for port in self._ports:
            self._forget(port)

    # -- one port -----------------------------------------------------------------------------------------------

    def _receive(self, port: _Port, endpoint: Endpoint) -> list[Message]:
        out: list[Message] = []
        for data, sender in endpoint.receive():
            if endpoint.datagrams:
                messages = port.codec.parse_datagram(data)
                if messages and not (sender == port.sender and (port.has_vehicle or self._vehicle is None)):
                    self._choose(port, endpoint, sender, messages)
            else:
                if sender != port.sender:
                    port.codec.forget()  # another client: it does not end the frame of the one before
                    port.sender = sender
                messages = port.codec.parse(data)
            out += messages
        return out

    def _choose(self, port: _Port, endpoint: Endpoint, sender: Sender, messages: list[Message]) -> None:
        """Answer the sender of these from now on, if it is the one to be answered."""
        of_vehicle = any(
            message.get_srcSystem() == self._vehicle and message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1
            for message in messages
        )
        port.has_vehicle = port.has_vehicle or of_vehicle
        if of_vehicle or not port.has_vehicle:
            endpoint.answer(sender)
            port.sender = sender

    def _open(self, port: _Port, now_s: float, *, wait: bool = False) -> EndpointError | None:
        """Open a port, as soon as its host's address is known; None also while it is looked up."""
        port.next_try_s = now_s + _RECONNECT_S
        parsed = parse(port.url)
        try:
            address = ""
            if parsed.kind != "serial":
                begun, port.lookup = port.lookup, port.lookup or Lookup(parsed.host)
                found = None if begun is None and port.lookup.beside else port.lookup.address()
                if found is None:
                    return None
                address = found
            port.lookup = None
            baud = port.bauds[port.baud_index] if port.bauds else None
            port.endpoint = open_endpoint(port.url, baud=baud, wait=wait, address=address)
        except EndpointError as error:
            port.lookup = None
            return error
        port.codec.forget()
        port.sender, port.has_vehicle = None, False
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
