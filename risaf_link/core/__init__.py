"""Numbers only: no clock, no log, no file, no asyncio.

Said once, for everything below
-------------------------------
Frames   n: local north-east-down. b: vehicle body, forward-right-down. s: one sensor's own axes.
         A vector carries the letter of its frame (`rate_b`); a rotation carries both, and letters
         meet: `v_n = R_nb @ v_b`.
Attitude `q_nb`: Hamilton unit quaternion (w, x, y, z), body to NED, as in ATTITUDE_QUATERNION.
         yaw: angle of the body's forward axis from true north, clockwise; heading: what GPS
         measures of it; course: direction of motion.
Units    SI: rad, rad/s, m/s, m/s^2. Time stamps are integer microseconds (`_us`) of the clock
         that the samples were stamped with; durations are float seconds.
Shapes   n sensors, three axes: `(n, 3)`. NaN marks a reading that is not valid.
Words    sensor: one triad; channel: one axis of one; epoch: all readings of one instant;
         residual: a sensor minus the fused rate; innovation: measured minus predicted;
         test ratio: |innovation| / (gate x its standard deviation), fused at or below 1.
"""
