"""Features of a processor, and of libraries on it, that decide the last bits of results."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import cache
from hashlib import sha256

#: OpenCV's number of a feature that its line leaves out.
_FMA3 = 12


@cache
def processor() -> str:
    """Return what OpenCV and NumPy use of this processor, and a digest of their results.

    Features that a variable of the environment switches off (``OPENCV_CPU_DISABLE``,
    ``OPENCV_IPP``, ``NPY_DISABLE_CPU_FEATURES``) count as missing. The digest covers the routines
    that OpenCV and NumPy choose by the features, and the results of the mathematical and linear
    algebra libraries for fixed numbers: none of them shows in the others, and code that Numba
    compiles gives the same bits on all.
    """
    import cv2  # noqa: PLC0415  (slow to import)
    import numpy as np  # noqa: PLC0415

    # OpenCV marks a feature with "?" that is there and not used.
    opencv = [
        name.lstrip("*") for name in cv2.getCPUFeaturesLine().split() if not name.endswith("?")
    ]
    opencv += ["FMA3"] * cv2.checkHardwareSupport(_FMA3)
    version = cv2.ipp.getIppVersion()
    ipp = version.partition(" (")[0] if cv2.ipp.useIPP() else "no IPP"
    routines = np.lib.introspect.opt_func_info(func_name="^(sin|cos|tan|exp|arctan)$")
    numpy = {each["current"] for types in routines.values() for each in types.values()}
    features = (
        f"{platform.machine()}, OpenCV {' '.join(opencv if cv2.useOptimized() else [])}, {ipp}, "
        f"NumPy {' '.join(sorted(numpy))}"
    )
    x = np.linspace(-3.0, 3.0, 64 * 64).reshape(64, 64)
    results = (
        *(function(x) for function in (np.sin, np.cos, np.tan, np.arctan, np.exp)),
        np.sin(x) @ np.cos(x),
        cv2.solve(np.sin(x * x), np.cos(x), flags=cv2.DECOMP_LU)[1],
    )
    parts = [features, version, str(routines), *(each.tobytes().hex() for each in results)]
    digest = sha256("\n".join(parts).encode()).hexdigest()
    return f"{features} ({digest[:12]})"


def differing_processors(counts: Mapping[str, int], things: str) -> list[str]:
    """Return a line on processors of several sets of features that compute one store; else none.

    Parameters
    ----------
    counts
        Number of ``things`` by :func:`processor`.
    things
        "workers" or "blocks".

    Examples
    --------
    >>> print(*differing_processors({"AVX2": 3, "SSE": 1}, "blocks"))
    processors with 2 different sets of features: last digits differ (3 blocks: AVX2; 1 blocks: SSE)
    """
    if len(counts) < 2:
        return []
    parts = "; ".join(f"{count:,} {things}: {name}" for name, count in sorted(
        counts.items(), key=lambda entry: (-entry[1], entry[0])))
    return [
        f"processors with {len(counts)} different sets of features: last digits differ ({parts})"
    ]
