"""The installation: what cannot work is refused in one line, what may surprise is warned of."""

from __future__ import annotations

import multiprocessing
from functools import cache
from importlib.metadata import Distribution, distributions

from sweep.errors import StoreError
from sweep.messages import notice, plain

#: The distribution of OpenCV that this project requires.
OPENCV = "opencv-contrib-python-headless"

#: Other distributions that install the package ``cv2``, into the same files.
OTHER_OPENCV = ("opencv-contrib-python", "opencv-python", "opencv-python-headless")

REMEDY = f"`pip install --force-reinstall {OPENCV}`"


def check_installation() -> None:
    """Refuse an installation that lacks ArUco or whose files are another project's.

    Another distribution of OpenCV is warned of, once: which OpenCV is loaded is recorded in every
    store (`sweep.store.provenance.fingerprint`).

    Raises
    ------
    StoreError
        In one line, with the command that mends it.
    """
    namesake = _installed("sweep")  # so was this one's distribution named up to 0.5
    if namesake is not None and all(
            each.value != "sweep.cli:main" for each in namesake.entry_points):
        raise StoreError(
            f"another project's package `sweep` ({namesake.version}) is installed, and its files "
            "overwrite those of fiducial-sweep: `pip uninstall sweep`, then "
            "`pip install --force-reinstall fiducial-sweep`"
        )
    check_opencv()
    if multiprocessing.parent_process() is None:  # a worker's client has said it
        _warn_of_other_opencv()


def check_opencv() -> None:
    """Refuse an OpenCV that cannot be imported, or that has no ArUco.

    Raises
    ------
    StoreError
        In one line, with the command that mends it.
    """
    try:
        import cv2  # noqa: PLC0415  (slow to import)
    except ImportError as error:
        raise StoreError(f"OpenCV cannot be imported: {plain(error)}; {REMEDY}") from None
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        version = getattr(cv2, "__version__", "of no version")
        raise StoreError(
            f"OpenCV {version} is loaded, which has no cv2.aruco.ArucoDetector: {REMEDY}"
        )


@cache
def _warn_of_other_opencv() -> None:
    """Write a line to stderr if OpenCV is installed in another way than this project asks for."""
    found = {name: package.version for name in (OPENCV, *OTHER_OPENCV)
             if (package := _installed(name)) is not None}
    if [*found] != [OPENCV]:
        import cv2  # noqa: PLC0415  (slow to import)

        listed = " and ".join(f"{name} {version}" for name, version in found.items())
        notice(
            f"warning: {listed or 'an unknown distribution'} installed OpenCV, not {OPENCV} alone; "
            f"OpenCV {cv2.__version__} is loaded and recorded in stores"
        )


def _installed(name: str) -> Distribution | None:
    return next(iter(distributions(name=name)), None)
