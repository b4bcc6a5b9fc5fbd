"""JPEG: an image through the encoder and the decoder that OpenCV has."""

from __future__ import annotations

import cv2
import numpy as np

from sweep.typing import Grey

BLOCK_PX = 8
"""Sides of the blocks that a grey image is compressed in, each on its own."""

TILE_PX = 1 << 14
"""Largest side of an image that is compressed at once, in whole blocks: JPEG ends at 65535."""


def compressed(image: Grey, quality: int) -> Grey:
    """Return an image (h, w) after compression with ``quality`` from 1 to 100.

    Blocks count from the image's first pixel: of a part of a frame they are those of the frame if
    it begins at multiples of :data:`BLOCK_PX`, and ends at these or with the frame.
    """
    result = np.empty_like(image)
    setting = [cv2.IMWRITE_JPEG_QUALITY, quality]
    for top in range(0, image.shape[0], TILE_PX):
        for left in range(0, image.shape[1], TILE_PX):
            tile = np.s_[top : top + TILE_PX, left : left + TILE_PX]
            done, code = cv2.imencode(".jpg", image[tile], setting)
            if not done:
                raise ValueError("OpenCV's JPEG encoder failed")
            result[tile] = np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return result
