"""Detectors in other Pythons: their environments, the process that searches, what is known of it.

Only NumPy and an OpenCV with ArUco are needed there, and Python 3.8 or newer.
"""
