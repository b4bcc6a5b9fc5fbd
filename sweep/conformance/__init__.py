"""Conformance of plug-ins: whether detectors and solvers are what they declare.

A plug-in is tried in a child process, which it may crash or never return to.
"""
