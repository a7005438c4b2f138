"""Serial endpoint."""

from __future__ import annotations

import os

from nff_companion.errors import EndpointError
from nff_companion.mavlink.endpoint import Url


class SerialPort:
    """A UART by pyserial, without blocking."""

    def __init__(self, url: str, parsed: Url) -> None:
        import serial

        self.url = url
        self._left = b""
        try:
            self._port = serial.Serial(parsed.host, parsed.number, timeout=0, write_timeout=0)
        except (OSError, ValueError) as error:
            raise EndpointError(f"{url}: cannot open: {error}; check the device, the baud and permissions") from error
        os.set_blocking(self._port.fileno(), False)

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return int(self._port.fileno())

    def receive(self) -> list[bytes]:
        """Bytes that have arrived."""
        try:
            data = self._port.read(4096)
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error}") from error
        return [data] if data else []

    def send(self, data: bytes) -> bool:
        """Write the frame, after what is left of the one before; False when it is dropped for want of room.

        pyserial's own write would wait for a slow line in a busy loop, and a frame cut short would spoil the next.
        """
        try:
            if self._left and not self._flush():
                return False
            self._left = data
            self._flush()
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error}") from error
        return True

    def _flush(self) -> bool:
        """Write what is left; True when nothing remains."""
        try:
            self._left = self._left[os.write(self.fileno(), self._left) :]
        except BlockingIOError:
            return False
        return not self._left

    def close(self) -> None:
        """Close the port."""
        self._port.close()
