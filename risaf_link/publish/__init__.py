"""Outputs that are not MAVLink."""
