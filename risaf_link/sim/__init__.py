"""Truth -> array -> faults -> frames: simulated vehicles, for tests, experiments and demos.

The same seed gives the same bytes. The local frame n is tangent to the earth where the vehicle
starts; the earth neither turns nor curves, unless a trajectory says so.
"""
