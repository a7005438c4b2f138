"""The published comparison (RA-L 2024): six controllers, 7.5 m/s rectangle, a motor lost in flight."""
