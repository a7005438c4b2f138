"""The parameters of a live autopilot, for who makes an airframe file of them. Asks, and changes nothing."""

from __future__ import annotations

import select
import time

from nff_companion.autopilots.adoption import is_vehicle
from nff_companion.errors import EndpointError
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Message, dialect
from nff_companion.mavlink.hub import Hub
from nff_companion.mavlink.services.parameter_list import ParameterList

_WAIT_S = 0.05
_HEARTBEAT_S = 1.0


def read(url: str, timeout_s: float) -> dict[str, float]:
    """Values by name, of the first vehicle that is heard at ``url``.

    Raises ConfigError for a bad URL, EndpointError where no autopilot answers in ``timeout_s``.
    """
    poll, began_s = select.poll(), time.monotonic()
    hub = Hub([url], 1, COMPANION_COMPONENT, poll, began_s)
    try:
        return _read(hub, poll, url, began_s + timeout_s)
    finally:
        hub.close()


def _read(hub: Hub, poll: select.poll, url: str, until_s: float) -> dict[str, float]:
    parameters: ParameterList | None = None
    heartbeat_s = -float("inf")
    while True:
        now = time.monotonic()
        if now >= until_s:
            state = "no autopilot heard" if parameters is None else f"{parameters.state} came"
            raise EndpointError(f"{url}: {state} in time; is the link up, and quick enough?")
        if now - heartbeat_s >= _HEARTBEAT_S:  # a router and a udpout peer must hear us to answer
            heartbeat_s = now
            hub.send(_heartbeat(), None, now)
        for descriptor, _ in poll.poll(1e3 * _WAIT_S):
            for message, _ in hub.read(descriptor, now):
                if parameters is None:
                    parameters = _met(message, hub)
                else:
                    parameters.observe(message, now)
        hub.maintain(now)
        if parameters is None:
            continue
        if parameters.complete:
            return parameters.values
        for request in parameters.due(now):
            hub.send(request, None, now)


def _met(message: Message, hub: Hub) -> ParameterList | None:
    sender = message.get_srcSystem(), message.get_srcComponent()
    if message.get_type() != "HEARTBEAT" or sender[1] != dialect.MAV_COMP_ID_AUTOPILOT1 or not is_vehicle(message):
        return None
    hub.adopt(sender[0])
    hub.set_system(sender[0])
    return ParameterList(sender, bytewise=message.autopilot == dialect.MAV_AUTOPILOT_PX4)


def _heartbeat() -> Message:
    kind = dialect.MAV_TYPE_ONBOARD_CONTROLLER
    return dialect.MAVLink_heartbeat_message(kind, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3)
