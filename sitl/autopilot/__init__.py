"""An autopilot as ArduCopter is: cascaded loops, its mixer, and the port through which a companion reaches it.

The structure and the default gains follow Copter 4.7 (AC_PosControl, AC_AttitudeControl, AP_MotorsMatrix).
"""
