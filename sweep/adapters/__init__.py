"""Detectors of other packages as plug-ins: their settings and conventions.

They are found by the entry points of pyproject.toml; a package that is not installed is reported
with the command that installs it.
"""
