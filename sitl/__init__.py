"""Emulated vehicle: an octorotor plant and an autopilot that speaks MAVLink.

Nothing in this package imports the companion's model of the vehicle: a mistake made twice would cancel out.
Shapes: N vehicles, m rotors; the first axis is always the vehicle. FRD body, NED world, SI units.
"""
