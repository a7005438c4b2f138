"""Adapters: one file an autopilot behind one small interface (base.py)."""
