"""Output that commands share: lines, JSON, and a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

MAX_LINES = 50
"""Lines of each kind that `sweep status` and `sweep verify` print."""


def say(text: str = "") -> None:
    """Print lines without control characters, whosever names and texts they quote."""
    from sweep.messages import plain  # noqa: PLC0415

    for line in text.split("\n"):
        print(plain(line, len(line)))


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object."""
    print(json.dumps(content, indent=2))


def check_png(output: str) -> None:
    """Check that a picture can be written, before it is computed.

    Raises
    ------
    StoreError
        If it cannot be.
    """
    from sweep.report.output_file import check_output_file  # noqa: PLC0415

    check_output_file(Path(output))


def write_png(output: str, image: Any) -> None:
    """Write an image (h, w) or (h, w, 3), blue-green-red, as a PNG file.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    import cv2  # noqa: PLC0415

    from sweep.report.output_file import write_output_file  # noqa: PLC0415

    _, encoded = cv2.imencode(".png", image)
    write_output_file(Path(output), encoded.tobytes())
