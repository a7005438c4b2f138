"""Stock ArduPilot, with our Lua applet on the autopilot's side."""
