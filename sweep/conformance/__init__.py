"""Conformance of detectors: whether corners, their order and IDs are what they declare.

A detector is tried in a child process, which it may crash or never return to.
"""
