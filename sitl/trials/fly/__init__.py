"""Flights on real firmware in its own simulator, or in our plant."""
