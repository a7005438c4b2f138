"""What of ArduPilot a Lua script sees, around the emulated loops: scripts run as they are, in a real Lua 5.3."""
