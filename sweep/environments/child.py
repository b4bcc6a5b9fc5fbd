"""The program that runs in another Python: it searches images with that Python's OpenCV.

Needs the standard library, NumPy and OpenCV with ArUco; Python 3.8 or newer, OpenCV 4.5.5 or newer.
It imports nothing of this package: another Python starts it by its path, with the number of an open
file that both processes map, in which the images are. Messages are a JSON object each, after its
length, on standard input and output.

First it sends what it is: ``{"opencv": ..., ...}``, or ``{"fault": one line}``. Then it answers
each request. ``{"size": bytes of the file, "new": {number: {"dictionary", "parameters"}}, "images":
[[number, rows, columns, offset], ...]}`` is answered by ``{"counts": [[markers, rejected, seconds],
...], "errors": {index: [text, is of the machine]}}``, then the corners of all images, float32, and
the IDs, int32. It ends if its standard input is closed, also amid a search.
"""

from __future__ import annotations

import sys

if __name__ == "__main__":
    del sys.path[0]  # this folder, whose modules are not meant

import hashlib
import json
import mmap
import os
import select
import struct
import threading
import time
from pathlib import Path
from typing import IO, Any

PROTOCOL = 1

LENGTH = struct.Struct("<Q")

OUT_OF_MEMORY = -4
"""``cv2.Error.StsNoMem``."""


def send(pipe: IO[bytes], message: dict[str, Any], payload: bytes = b"") -> None:
    """Send an object, and bytes after it."""
    encoded = json.dumps(message).encode()
    pipe.write(LENGTH.pack(len(encoded)) + encoded + payload)
    pipe.flush()


def receive(pipe: IO[bytes]) -> Any:
    """Return the next object; None if the pipe was closed."""
    header = pipe.read(LENGTH.size)
    if len(header) < LENGTH.size:
        return None
    (length,) = LENGTH.unpack(header)
    encoded = pipe.read(length)
    return json.loads(encoded.decode()) if len(encoded) == length else None


def digest(text: str | bytes) -> str:
    """Return the beginning of the SHA-256 of text or bytes."""
    return hashlib.sha256(text if isinstance(text, bytes) else text.encode()).hexdigest()[:12]


def make_parameters(aruco: Any) -> Any:
    """Return the default ``DetectorParameters``; before OpenCV 4.7 a function makes them."""
    if hasattr(aruco, "ArucoDetector"):
        return aruco.DetectorParameters()
    return aruco.DetectorParameters_create()


def plain_fields(parameters: Any) -> dict[str, Any]:
    """Return name -> value of the fields of detector parameters."""
    return {
        name: getattr(parameters, name) for name in dir(parameters)
        if not name.startswith("_") and isinstance(getattr(parameters, name), (bool, int, float))
    }


def markers_digest(dictionary: Any) -> str:
    """Return a digest of a dictionary's upright markers: the bits, not how many are corrected."""
    import numpy as np  # noqa: PLC0415  (told if it is missing)

    upright = np.ascontiguousarray(dictionary.bytesList[:, :, 0])
    return digest(b"%d %d " % (dictionary.markerSize, len(upright)) + upright.tobytes())


def identity() -> dict[str, Any]:
    """Return what results depend on here; a `fault` if nothing can be searched."""
    said = {"protocol": PROTOCOL, "python": ".".join(map(str, sys.version_info[:3]))}
    try:
        import numpy as np  # noqa: PLC0415
    except Exception as error:
        return dict(said, fault="has no NumPy that can be imported: " + exception_line(error))
    try:
        import cv2  # noqa: PLC0415
    except Exception as error:
        return dict(said, fault="has no OpenCV that can be imported: " + exception_line(error))
    aruco: Any = getattr(cv2, "aruco", None)
    if not hasattr(aruco, "detectMarkers") and not hasattr(aruco, "ArucoDetector"):
        version = getattr(cv2, "__version__", "of no version")
        hint = "opencv-contrib-python has it"
        return dict(said, fault=f"has OpenCV {version} without ArUco ({hint})")
    cv2.setNumThreads(1)
    numpy_build = digest(Path(np.__config__.__file__).read_bytes())
    names = sorted(name for name in dir(aruco) if name.startswith("DICT_"))
    predefined = {name: aruco.getPredefinedDictionary(getattr(aruco, name)) for name in names}
    return dict(
        said, opencv=cv2.__version__, opencv_build=digest(cv2.getBuildInformation()),
        numpy=np.__version__, numpy_build=numpy_build,
        fields=plain_fields(make_parameters(aruco)),
        dictionaries={name: markers_digest(each) for name, each in predefined.items()},
    )


def exception_line(error: Exception) -> str:
    """Return an exception as one line."""
    kind = type(error)
    name = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
    lines = str(error).strip().splitlines()
    return f"{name}: {lines[0]}" if lines else name


def make_search(definition: dict[str, Any]) -> Any:
    """Return OpenCV's search of an image by a definition: dictionary and parameters."""
    import cv2  # noqa: PLC0415

    aruco: Any = cv2.aruco
    parameters = make_parameters(aruco)
    for name, value in definition["parameters"].items():
        refinement = name == "cornerRefinementMethod"
        setattr(parameters, name, getattr(aruco, "CORNER_REFINE_" + value) if refinement else value)
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, definition["dictionary"]))
    if hasattr(aruco, "ArucoDetector"):
        return aruco.ArucoDetector(dictionary, parameters).detectMarkers
    return lambda image: aruco.detectMarkers(image, dictionary, parameters=parameters)


def search_all(
    images: list[list[int]], searches: dict[int, Any], shared: Any
) -> tuple[list[Any], dict[int, Any], Any, Any]:
    """Search images; return counts, errors, and corners and IDs as arrays."""
    import numpy as np  # noqa: PLC0415

    counts: list[Any] = []
    errors: dict[int, Any] = {}
    quads: list[Any] = [np.empty((0, 4, 2), np.float32)]
    ids: list[Any] = [np.empty(0, np.int32)]
    for index, (number, rows, columns, offset) in enumerate(images):
        image = np.frombuffer(shared, np.uint8, rows * columns, offset).reshape(rows, columns)
        start = time.perf_counter()
        try:
            found, found_ids, rejected = searches[number](image)
        except Exception as error:
            memory = isinstance(error, MemoryError) or getattr(error, "code", 0) == OUT_OF_MEMORY
            errors[index] = [exception_line(error), memory]
            found, found_ids, rejected = (), None, ()
        counts.append([len(found), len(rejected), time.perf_counter() - start])
        quads += [np.reshape(quad, (1, 4, 2)) for quad in (*found, *rejected)]
        if found_ids is not None:
            ids.append(np.ravel(found_ids))
        del image
    return (
        counts, errors, np.concatenate(quads).astype(np.float32),
        np.concatenate(ids).astype(np.int32),
    )


def end_with(descriptor: int) -> None:
    """End this process as soon as a pipe's other end is closed, whatever it does."""
    poll = select.poll()
    poll.register(descriptor, 0)  # only that the other end is closed
    poll.poll()
    os._exit(0)


def serve(shared_file: int) -> None:
    """Say what this is, and answer requests until the pipe is closed."""
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    threading.Thread(target=end_with, args=(requests.fileno(),), daemon=True).start()
    os.dup2(2, 1)  # what libraries print must not mix with the answers
    said = identity()
    send(answers, said)
    if "fault" in said:
        return
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null, descriptor)
    searches: dict[int, Any] = {}
    size, shared = 0, None
    while True:
        request = receive(requests)
        if request is None:
            return
        for number, definition in request["new"].items():
            searches[int(number)] = make_search(definition)
        if request["size"] != size:
            size = request["size"]
            shared = mmap.mmap(shared_file, size, access=mmap.ACCESS_READ)
        counts, errors, corners, ids = search_all(request["images"], searches, shared)
        send(answers, {"counts": counts, "errors": errors}, corners.tobytes() + ids.tobytes())


if __name__ == "__main__":
    serve(int(sys.argv[1]))
