"""Holds ``nff.py``, generated from ``mavlink_dialect/nff.xml`` at install; never edited."""
