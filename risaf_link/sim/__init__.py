"""Truth -> array -> faults -> frames: simulated vehicles, for tests, experiments and demos.

The same seed gives the same bytes. Drives are on the turning ellipsoid, and n is north, east, down
where the vehicle is; on the circle the earth is flat and does not turn.
"""
