"""The installation: what cannot work is refused in one line, what may surprise is warned of."""

from __future__ import annotations

import multiprocessing
from functools import cache
from importlib.metadata import distributions

from sweep.errors import StoreError
from sweep.messages import notice, plain

#: The distribution of OpenCV that this project requires.
OPENCV = "opencv-contrib-python-headless"

#: Other distributions that install the package ``cv2``, into the same files.
OTHER_OPENCV = ("opencv-contrib-python", "opencv-python", "opencv-python-headless")

REMEDY = f"`pip install --force-reinstall {OPENCV}`"


@cache
def check_installation() -> None:
    """Refuse an OpenCV that cannot be imported, or that has no ArUco.

    Another distribution of OpenCV is warned of in a line on stderr, once: which OpenCV is loaded
    is recorded in every store (`sweep.store.provenance.fingerprint`).

    Raises
    ------
    StoreError
        In one line, with the command that mends it.
    """
    try:
        import cv2  # noqa: PLC0415  (slow to import)

        loaded, _ = f"OpenCV {cv2.__version__} is loaded", cv2.aruco.ArucoDetector
    except (ImportError, AttributeError) as error:
        raise StoreError(f"OpenCV cannot be used: {plain(error)}; {REMEDY}") from None
    found = {name: package.version for name in (OPENCV, *OTHER_OPENCV)
             for package in distributions(name=name)}
    if [*found] != [OPENCV] and multiprocessing.parent_process() is None:  # else its client says it
        listed = " and ".join(f"{name} {version}" for name, version in found.items())
        notice(f"warning: {listed or 'an unknown distribution'} installed OpenCV, not {OPENCV} "
               f"alone; {loaded} and recorded in stores")
