"""The detector of the package pyapriltags: AprilTag's C library 3.4, with its fix of edges."""

from __future__ import annotations

from sweep.adapters.apriltag import wrapper_plugin

DETECTOR = wrapper_plugin(
    "pyapriltags", "pyapriltags", "AprilTag's C library 3.4 (pyapriltags)"
)
