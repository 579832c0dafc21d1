"""Sensors and receivers that vehicles carry."""

import math

from risaf_link.core.earth import GRAVITY
from risaf_link.sim.disturbances import Thermal
from risaf_link.sim.receiver import ReceiverParameters
from risaf_link.sim.sensors import TriadErrors

# As a calibrated array of consumer parts has them; the paper gives no numbers. Data sheet: that of
# the MPU-6050, rev. 3.4, sections 6.1 and 6.2.
CONSUMER_GYROS = TriadErrors(
    # Twice the data sheet's, which is that of one part at 10 Hz and rest: 0.1 deg/s a sample at
    # 100 Hz, 0.6 deg/sqrt(h).
    noise_density=math.radians(0.01),
    # What calibration leaves from one power-up to the next; the data sheet allows 20 without.
    initial_bias=math.radians(0.2),
    # An Allan deviation of 0.017 deg/s at 100 s, as of a part whose temperature changes; 100 of
    # them together turn 0.5 deg in 200 s without GPS.
    bias_walk=math.radians(0.003),
    # The data sheet's smallest; a count is a thirteenth of the noise.
    full_scale=math.radians(250.0),
)

CONSUMER_ACCELEROMETERS = TriadErrors(
    noise_density=400e-6 * GRAVITY,  # the data sheet's
    initial_bias=5e-3 * GRAVITY,  # a tenth of the data sheet's, which is without calibration
    bias_walk=5e-5 * GRAVITY,
    full_scale=8.0 * GRAVITY,  # bumps of a rough road reach beyond 2 g
)

WARMING = Thermal(common=math.radians(0.05), own=math.radians(0.1), time_constant=300.0)
"""Of gyros that were switched on when the drive began: a sound array drifts too, and together.

By ten kelvins or so, with the coefficients that calibration leaves: in 250 s without GPS, from
400 s on, the mean of 100 sound sensors turns about half a degree.
"""

# The one IMU and the receiver that PX4's EKF2 was run on (requirement of the scenario `ekf2`).
EKF2_GYRO = TriadErrors(
    noise_density=math.radians(0.01),  # 0.1 deg/s a sample at 100 Hz
    initial_bias=math.radians(0.2),
    bias_walk=math.radians(3e-4),
    full_scale=math.radians(250.0),
    equal_biases=True,
)
EKF2_ACCELEROMETER = TriadErrors(
    noise_density=0.005,  # 0.05 m/s^2 a sample at 100 Hz
    initial_bias=0.0,
    bias_walk=0.0,
    full_scale=4.0 * GRAVITY,
)
EKF2_RECEIVER = ReceiverParameters(
    rate=5.0,
    velocity_noise=0.1,
    position_noise=1.5,
    altitude_noise=2.0,
    time_constant=0.0,
    latency=0.0,
)
