"""AprilTag's families that OpenCV lacks: their codes are read from an installed AprilTag library.

In these families data lies outside the square whose corners are detected, too: beyond a black
ring around it, while the ring inside it is white (Krogius, Haggenmiller, Olson, "Flexible layouts
for fiducial tags", IROS 2019, section III).
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MissingPackageError


@dataclass(frozen=True, slots=True)
class TagFamily:
    """The layout of a family.

    Attributes
    ----------
    modules
        Along the side of the square whose corners are detected.
    overhang
        Modules beyond that square on each side.
    count
        IDs.
    sha256
        Digest of codes and positions of bits: a library with others is refused.
    """

    modules: int
    overhang: int
    count: int
    sha256: str


TAG_FAMILIES = {
    "tagCircle21h7": TagFamily(
        5, 2, 38, "25b2d4816d658f6a3e50433e8afe0728b2b384b45bbd4d58e6d1888e0848d1c1"
    ),
    "tagCircle49h12": TagFamily(
        5, 3, 65_535, "366a1f684df9ad1d608021dce1123881606fca0f66b67b07b83f75babbe2b734"
    ),
    "tagCustom48h12": TagFamily(
        6, 2, 42_211, "b84f4ca90d0cf10e34fb5e8603db4f10aabb9f8abc73daacae159c106ab1924a"
    ),
    "tagStandard41h12": TagFamily(
        5, 2, 2_115, "dbc172f60f18d0b06b4a6e608cb19eb17c38081e522946148bf244402d885d2b"
    ),
    "tagStandard52h13": TagFamily(
        6, 2, 48_714, "3150751035d317dc0da6dff9b9ccd58794170f7c30a2f8335104b837642c9871"
    ),
}
"""By AprilTag's own names. Numbers and digests are those of AprilTag 3.1 to 3.4."""

PACKAGES = ("pyapriltags", "pupil_apriltags")
"""Python packages whose AprilTag library has all families."""


class _Family(ctypes.Structure):
    """The beginning of ``apriltag_family_t`` of AprilTag 3."""

    _fields_ = (
        ("ncodes", ctypes.c_uint32),
        ("codes", ctypes.POINTER(ctypes.c_uint64)),
        ("width_at_border", ctypes.c_int),
        ("total_width", ctypes.c_int),
        ("reversed_border", ctypes.c_bool),
        ("nbits", ctypes.c_uint32),
        ("bit_x", ctypes.POINTER(ctypes.c_int32)),
        ("bit_y", ctypes.POINTER(ctypes.c_int32)),
    )


def library_path() -> Path | None:
    """Return the AprilTag library of the first installed package that brings one, or None."""
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        for folder in (spec and spec.submodule_search_locations) or ():
            for pattern in ("libapriltag.so", "lib*/libapriltag.so", "libapriltag.dylib"):
                for path in sorted(Path(folder).glob(pattern)):
                    return path
    return None


def missing_library() -> str | None:
    """Return what to install for the families' codes; None if a library is installed."""
    if library_path() is not None:
        return None
    return "an AprilTag library for its codes: pip install 'fiducial-sweep[pyapriltags]'"


@lru_cache(maxsize=8)
def _codes(name: str) -> tuple[NDArray[np.uint64], NDArray[np.int32]]:
    """Return a family's codes (count,), and the positions (bits, 2) of its bits: column, row.

    Bits count from the code's highest; positions from the first module inside the square.
    """
    path = library_path()
    if path is None:
        raise MissingPackageError(f"{name} needs {missing_library()}")
    create = getattr(ctypes.CDLL(str(path)), f"{name}_create")
    create.restype = ctypes.POINTER(_Family)
    family = create().contents  # the library keeps it; it is read once in a process
    codes = np.array(family.codes[: family.ncodes], dtype=np.uint64)
    positions = np.array(
        [family.bit_x[: family.nbits], family.bit_y[: family.nbits]], dtype=np.int32
    ).T
    digest = hashlib.sha256(codes.astype("<u8").tobytes() + positions.astype("<i4").tobytes())
    if digest.hexdigest() != TAG_FAMILIES[name].sha256:
        raise MissingPackageError(
            f"{name}: the codes in {path} are not AprilTag's; install another pyapriltags"
        )
    return codes, positions


def tag_cells(name: str, marker_id: int) -> NDArray[np.bool_]:
    """Return the modules (n + 2 overhang,) squared of a tag, True for white, top row first.

    Modules without a bit beyond the black ring, and in the middle of Custom48h12, are white: on
    the published images they are transparent.

    Raises
    ------
    MissingPackageError
        No package with an AprilTag library is installed.
    """
    family = TAG_FAMILIES[name]
    codes, positions = _codes(name)
    n, start = family.modules, family.overhang
    white = np.ones((n + 2 * start, n + 2 * start), dtype=np.bool_)
    ring = np.s_[start - 1 : start + n + 1]
    white[ring, ring] = False
    white[start : start + n, start : start + n] = True
    shift = np.arange(len(positions) - 1, -1, -1, dtype=np.uint64)
    column, row = (positions + start).T
    white[row, column] = (codes[marker_id] >> shift & np.uint64(1)).astype(np.bool_)
    return white
