"""Output that commands share: JSON, and a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sweep.errors import StoreError

MAX_LINES = 50
"""Lines of each kind that `sweep status` and `sweep verify` print."""


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object."""
    print(json.dumps(content, indent=2))


def write_png(output: str, image: Any) -> None:
    """Write an image (h, w) or (h, w, 3), blue-green-red, as a PNG file.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    import cv2  # noqa: PLC0415

    _, encoded = cv2.imencode(".png", image)
    try:
        Path(output).write_bytes(encoded.tobytes())
    except OSError as error:
        raise StoreError(f"{output}: cannot be written: {error.strerror}") from None
