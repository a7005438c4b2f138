"""Companion-computer daemon that keeps a multirotor flying after motor failures."""

__version__ = "0.1.0"
