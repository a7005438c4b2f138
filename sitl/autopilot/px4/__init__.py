"""What of PX4 v1.16 a companion meets, around the emulated loops: parameters, the allocation of them, telemetry."""
