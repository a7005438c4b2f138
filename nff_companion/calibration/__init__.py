"""A vehicle's numbers from its own healthy flight."""
