"""Times of the protocol between companion and autopilot, once. The applet's file of the card is written from here."""

# What the autopilot honours, and how long.
MATRIX_TIMEOUT_S = 0.5
PROBE_TIMEOUT_S = 0.15  # of a matrix that moves motors to test them: should its end be lost, it ends by itself
OVERRIDE_TIMEOUT_S = 0.1
MATRIX_TIMEOUT_MAX_S = 2.0
STALE_S = 0.25  # a command that answers an older sample is refused
EARLY_S = 0.05  # and one from the future
LINK_LOST_S = 1.0  # without a packet of the companion: its matrix is given up, its declarations stay
OWNER_LOST_S = 1.0  # and another companion may take its place
STOP_S = 0.02  # a stopped motor's channel is held this long, and renewed at each run
APPLIED_INTERVAL_S = 0.05  # between two words of what is in force

# The applet and its watchdog, each of the other. A late run: the watchdog may have put its own factors in force.
APPLET_LATE_S = 0.2
APPLET_DEAD_S = 0.3
WATCHDOG_SILENT_S = 0.5
WATCHDOG_CALM_S = 0.05  # between two looks
WATCHDOG_ACTIVE_S = 0.01  # while it holds motors stopped
WATCHDOG_STOP_S = 0.03

# What the companion does.
DECLARATION_INTERVAL_S = 0.05  # an unconfirmed declaration is told again
MATRIX_INTERVAL_S = 0.05
HEARTBEAT_INTERVAL_S = 0.2
ANSWER_MAX_S = 1.0  # an autopilot silent for longer does not obey either
CONFIRM_MAX_S = 0.5  # a command not confirmed for longer is said not to be in force
ORDER_MAX_S = 5.0  # an operator's order that cannot be told for longer is dropped
GROUND_PATIENCE_S = 4.0  # before an applet that has not answered is called silent: scripts start late
