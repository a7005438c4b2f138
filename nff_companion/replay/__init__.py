"""Flight logs through the same pipeline as in flight."""
