"""Frames by name, as ArduPilot and PX4 number their motors: the catalogue, drawings, and airframe files made of it."""
