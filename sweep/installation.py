"""Installations that cannot work: reported in one line before anything is computed."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from sweep.errors import StoreError

OPENCV = "opencv-contrib-python-headless"
"""The distribution of OpenCV that this project requires."""

OPENCV_DISTRIBUTIONS = (
    OPENCV, "opencv-contrib-python", "opencv-python", "opencv-python-headless",
)
"""All distributions that install the package ``cv2``, into the same files."""

NAMESAKE = "sweep"
"""A distribution of another project, whose package has the same name as this one's."""

COMMAND = "sweep.cli:main"
"""The entry point of this project's distributions, under whichever name."""


def check_installation() -> None:
    """Refuse installations whose files overwrite each other, or that lack OpenCV.

    Raises
    ------
    StoreError
        If OpenCV is missing, if another or several distributions of it are installed, or if the
        other project's distribution ``sweep`` is; one line each, with the commands to run.
    """
    for problem in _problems():
        raise StoreError(problem)


def check_loaded_opencv(loaded: str) -> None:
    """Refuse an OpenCV that is not the one that is installed.

    Parameters
    ----------
    loaded
        Its own version, ``cv2.__version__``.

    Raises
    ------
    StoreError
        If it contradicts the version that the package's metadata name; in one line.
    """
    package = _installed(OPENCV)
    own = loaded.partition("-")[0].split(".")
    if package is not None and package.version.split(".")[:3] != own:
        raise StoreError(
            f"OpenCV {loaded} is loaded, but {OPENCV} {package.version} is installed: another "
            "package has overwritten its files, or stands before it in Python's path; "
            f"`pip install --force-reinstall {OPENCV}`"
        )


def _problems() -> Iterator[str]:
    namesake = _installed(NAMESAKE)
    if namesake is not None and not _is_ours(namesake):
        yield (
            f"another project's package `sweep` ({namesake.version}) is installed, and its files "
            "overwrite those of fiducial-sweep: `pip uninstall sweep`, then "
            "`pip install --force-reinstall fiducial-sweep`"
        )
    versions = {
        name: package.version for name in OPENCV_DISTRIBUTIONS
        if (package := _installed(name)) is not None
    }
    listed = " and ".join(f"{name} {version}" for name, version in versions.items())
    replace = f"`pip uninstall {' '.join(versions)}`, then `pip install {OPENCV}`"
    if len(versions) > 1:
        yield (f"several distributions of OpenCV are installed and overwrite each other: {listed}; "
               f"{replace}")
    elif versions and OPENCV not in versions:
        yield f"{listed} is installed in place of {OPENCV}: {replace}"
    elif not versions or importlib.util.find_spec("cv2") is None:
        yield f"OpenCV is missing: `pip install --force-reinstall {OPENCV}`"


def _installed(name: str) -> Distribution | None:
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def _is_ours(namesake: Distribution) -> bool:
    """Return whether a distribution is this project's; it was named ``sweep`` up to 0.5."""
    return any(entry.value == COMMAND for entry in namesake.entry_points)
