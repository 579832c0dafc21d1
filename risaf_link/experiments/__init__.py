"""The paper's comparisons: every method on the very same input, scored against truth and GPS.

The paper is Hanani and Kipnis, "Robust Extended Kalman Filter for Land Navigation Using Massive
Array of MEMS IMUs". A method of one's own takes twenty lines: see `method`.
"""
