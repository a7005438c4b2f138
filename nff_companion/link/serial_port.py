"""Serial endpoint."""

from __future__ import annotations

from nff_companion.errors import EndpointError
from nff_companion.link.endpoint import Url


class SerialPort:
    """A UART by pyserial, without blocking."""

    def __init__(self, url: str, parsed: Url) -> None:
        import serial

        self.url = url
        try:
            self._port = serial.Serial(parsed.host, parsed.number, timeout=0, write_timeout=0)
        except (OSError, ValueError) as error:
            raise EndpointError(f"{url}: cannot open: {error}; check the device, the baud and permissions") from error

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
        """Write what fits now; False when not all did."""
        import serial

        try:
            return self._port.write(data) == len(data)
        except serial.SerialTimeoutException:
            return False
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error}") from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()
