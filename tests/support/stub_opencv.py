"""Pythons whose OpenCV is a stub that has faults: quick to start, and nothing is to install."""

import sys
import textwrap

import cv2
import numpy as np

STUB = """
import os, sys, time, types
import numpy as np

print("a library's greeting")
__version__ = "4.5.0"


class error(Exception):
    pass


def getBuildInformation():
    return "stub"


def setNumThreads(_):
    pass


class _Parameters:
    pass


class _Dictionary:
    markerSize, maxCorrectionBits = 5, 0
    bytesList = np.load(os.path.join(os.path.dirname(__file__), "markers.npy"))


def _parameters():
    made = _Parameters()
    made.cornerRefinementMethod, made.minMarkerDistanceRate = 0, 0.05
    made.minMarkerPerimeterRate, made.maxMarkerPerimeterRate = 0.03, 4.0
    return made


def _search(image, dictionary, parameters):
    print("searching")
    level = int(image.max())
    if level == 201:
        os.kill(os.getpid(), 11)
    if level == 202:
        raise error("no such image")
    if level == 203:
        time.sleep(600)
    if level == 204:
        os.kill(os.getpid(), 9)
    if level == 205:
        raise MemoryError
    height, width = image.shape
    quad = np.array([[[0, 0], [width, 0], [width, height], [0, height]]], np.float32)
    return (quad,), np.array([[7]], np.int32), (quad + 1, quad + 2)


aruco = types.SimpleNamespace(
    DICT_5X5_50=0, CORNER_REFINE_NONE=0, CORNER_REFINE_SUBPIX=1, detectMarkers=_search,
    DetectorParameters_create=_parameters, getPredefinedDictionary=lambda _: _Dictionary(),
)
"""


def stub_python(folder, cv2_text=STUB):
    """Return the path of a Python that imports a stub of OpenCV from a folder."""
    (folder / "cv2.py").write_text(textwrap.dedent(cv2_text))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    np.save(folder / "markers.npy", dictionary.bytesList)
    return script(folder / "python", f'PYTHONPATH="$(dirname "$0")" exec "{sys.executable}" "$@"')


def script(path, command):
    """Return the path of an executable shell script."""
    path.write_text(f"#!/bin/sh\n{command}\n")
    path.chmod(0o755)
    return str(path)
