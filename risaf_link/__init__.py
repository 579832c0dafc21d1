"""One trustworthy attitude and heading from an array of cheap MEMS gyros, over MAVLink."""

__version__ = "0.1.0"
