"""Serial endpoint."""

from __future__ import annotations

import contextlib
import os
import termios

from nff_companion.errors import EndpointError
from nff_companion.mavlink.send_queue import SendQueue
from nff_companion.mavlink.urls import Url


class SerialPort:
    """A UART by pyserial, without blocking."""

    datagrams = False

    def __init__(self, url: str, parsed: Url) -> None:
        import serial

        self.url = url
        try:
            self._port = serial.Serial(parsed.host, parsed.number, timeout=0, write_timeout=0)
        except (OSError, ValueError, termios.error) as error:  # the last where it is pulled out while it is opened
            raise EndpointError(f"{url}: cannot open: {error}; check the device, the baud and permissions") from error
        os.set_blocking(self._port.fileno(), False)
        # pyserial's own write would wait for a slow line in a busy loop.
        self._queue = SendQueue(lambda data: os.write(self._port.fileno(), data))

    @property
    def connected(self) -> bool:
        """A line has another end as long as it is open."""
        return True

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return int(self._port.fileno())

    def receive(self) -> list[tuple[bytes, tuple[str, int] | None]]:
        """Bytes that have arrived."""
        try:
            data = self._port.read(4096)
        except (OSError, termios.error) as error:
            raise EndpointError(f"{self.url}: lost: {error}") from error
        return [(data, None)] if data else []

    def answer(self, sender: tuple[str, int] | None) -> None:
        """There is but one."""

    def send(self, data: bytes) -> bool:
        """Write the frame after what waits; False when it is dropped for want of room."""
        try:
            return self._queue.send(data)
        except (OSError, termios.error) as error:
            raise EndpointError(f"{self.url}: lost: {error}") from error

    def flush(self) -> None:
        """Write of what waits as much as the line takes."""
        try:
            self._queue.flush()
        except (OSError, termios.error) as error:
            raise EndpointError(f"{self.url}: lost: {error}") from error

    def close(self) -> None:
        """Close the port."""
        # Closing waits for what the driver still holds, on a stalled line for half a minute; a device that was pulled
        # out has nothing to discard.
        with contextlib.suppress(OSError, termios.error):
            self._port.reset_output_buffer()
        self._port.close()
