"""The daemon: its loop, clocks, signals, configuration, and its door for the monitor."""
