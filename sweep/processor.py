"""Features of a processor, and of libraries on it, that decide the last bits of results."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import cache
from hashlib import sha256

#: OpenCV's number of a feature that its line leaves out.
_FMA3 = 12


@cache
def processor_features() -> str:
    """Return the processor's features that OpenCV and NumPy use in this process, as one line.

    Features that a variable of the environment switches off (``OPENCV_CPU_DISABLE``,
    ``OPENCV_IPP``, ``NPY_DISABLE_CPU_FEATURES``) count as missing.
    """
    import cv2  # noqa: PLC0415  (slow to import)
    import numpy as np  # noqa: PLC0415

    # OpenCV marks a feature with "?" that is there and not used.
    opencv = [
        name.lstrip("*") for name in cv2.getCPUFeaturesLine().split() if not name.endswith("?")
    ]
    opencv += ["FMA3"] * cv2.checkHardwareSupport(_FMA3)
    ipp = cv2.ipp.getIppVersion().partition(" (")[0] if cv2.ipp.useIPP() else "no IPP"
    targets = np.lib.introspect.opt_func_info(func_name="^(sin|cos|tan|exp|arctan)$")
    numpy = {
        target["current"] for types in targets.values() for target in types.values()
    }
    return (
        f"{platform.machine()}, OpenCV {' '.join(opencv if cv2.useOptimized() else [])}, {ipp}, "
        f"NumPy {' '.join(sorted(numpy))}"
    )


@cache
def processor() -> str:
    """Return the features, and a digest of everything here that results depend on to the last bit.

    The digest covers the routines that OpenCV and NumPy choose by the processor's features, and the
    results of the mathematical and linear algebra libraries for fixed numbers: none of them shows
    in the others, and code that Numba compiles gives the same bits on all.
    """
    import cv2  # noqa: PLC0415  (slow to import)
    import numpy as np  # noqa: PLC0415

    x = np.linspace(-3.0, 3.0, 64 * 64).reshape(64, 64)
    parts = [
        processor_features(),
        cv2.ipp.getIppVersion(),
        str(np.lib.introspect.opt_func_info(func_name="^(sin|cos|tan|exp|arctan)$")),
        *(f(x).tobytes().hex() for f in (np.sin, np.cos, np.tan, np.arctan, np.exp)),
        (np.sin(x) @ np.cos(x)).tobytes().hex(),
        cv2.solve(np.sin(x * x), np.cos(x), flags=cv2.DECOMP_LU)[1].tobytes().hex(),
    ]
    digest = sha256("\n".join(parts).encode()).hexdigest()
    return f"{processor_features()} ({digest[:12]})"


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
    ordered = sorted(counts.items(), key=lambda entry: (-entry[1], entry[0]))
    parts = "; ".join(f"{count:,} {things}: {name}" for name, count in ordered)
    return [
        f"processors with {len(counts)} different sets of features: last digits differ ({parts})"
    ]
