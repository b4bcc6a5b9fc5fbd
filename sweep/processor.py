"""Features of a processor, and of libraries on it, that decide the last bits of results."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import cache
from hashlib import sha256


@cache
def processor() -> str:
    """Return the features that OpenCV and NumPy find on this processor, and a digest of results.

    Features that a variable of the environment switches off (``OPENCV_CPU_DISABLE``,
    ``OPENCV_IPP``, ``NPY_DISABLE_CPU_FEATURES``) are missing, or marked by "?". The digest covers
    the results of the mathematical and linear algebra libraries for fixed numbers, which do not
    show in the features; code that Numba compiles gives the same bits on all.
    """
    import cv2  # noqa: PLC0415  (slow to import)
    import numpy as np  # noqa: PLC0415

    found = np.show_config("dicts").get("SIMD Extensions", {}).get("found", ())
    ipp = cv2.ipp.getIppVersion().partition(" (")[0] if cv2.ipp.useIPP() else "no IPP"
    x = np.linspace(-3.0, 3.0, 64 * 64).reshape(64, 64)
    results = (
        *(function(x) for function in (np.sin, np.cos, np.tan, np.arctan, np.exp)),
        np.sin(x) @ np.cos(x),
        cv2.solve(np.sin(x * x), np.cos(x), flags=cv2.DECOMP_LU)[1],
    )
    digest = sha256(b"".join(each.tobytes() for each in results)).hexdigest()
    return (f"{platform.machine()}, OpenCV {cv2.getCPUFeaturesLine()}, {ipp}, "
            f"NumPy {' '.join(found)} ({digest[:12]})")


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
    parts = "; ".join(f"{count:,} {things}: {name}" for name, count in sorted(counts.items()))
    line = f"processors with {len(counts)} different sets of features: last digits differ ({parts})"
    return [line] if len(counts) > 1 else []
