"""The companion's own control law, for the override mode. Pure."""
