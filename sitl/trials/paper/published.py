"""What the paper reports (RA-L 2024): table I and the text to figure 7."""

# Peak of the mean attitude error after the failure, degrees: roll, pitch, yaw.
PEAK_ATTITUDE_ERROR_DEG = {
    "outer": {
        "baseline": (8.4, 8.1, 12.9),
        "nf": (9.9, 9.5, 15.7),
        "nff": (7.5, 7.4, 7.0),
        "omniscient": (3.6, 3.4, 1.9),
    },
    "inner": {
        "baseline": (4.4, 7.8, 6.0),
        "nf": (4.4, 7.2, 6.6),
        "nff": (4.0, 6.4, 5.2),
        "omniscient": (2.0, 2.7, 1.7),
    },
}
# Mean position error on the rectangle after an outer failure, m.
MEAN_POSITION_ERROR_M = {"baseline": 0.44, "nf": 0.81, "nff": 0.23, "omniscient": 0.25}
