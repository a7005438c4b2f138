"""Flights of companion and emulated vehicle together: surveys, demonstration, benchmarks, peers."""
