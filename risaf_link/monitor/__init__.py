"""The ground station's page: a MAVLink client like any other.

Frames, live or from a log, go into a model of what is known (`vehicles`, `traffic`); a web server
sends it to the page ten times a second.
"""
