"""The plant, its faults and its wind as the physics of a real autopilot in its own SITL."""
