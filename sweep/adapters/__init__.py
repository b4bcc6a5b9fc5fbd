"""Detectors of other packages as plug-ins: their settings, and their conventions for corners.

Each module imports its package only when a detector is made. Plug-ins are found by the entry points
of pyproject.toml; a package that is not installed is reported with the command that installs it.
"""
