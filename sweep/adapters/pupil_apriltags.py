"""The detector of the package pupil-apriltags: AprilTag's C library before its fix of edges."""

from __future__ import annotations

from sweep.adapters.apriltag import wrapper_plugin

DETECTOR = wrapper_plugin(
    "pupil_apriltags", "pupil-apriltags", "AprilTag's C library 3.1 (pupil-apriltags)"
)
