"""Rates of false markers, by dictionary and `errorCorrectionRate`.

Images without markers: blurred noise; rectangles in random places and greys; squares with a black
border and random bits, the worst that a scene can show, for which the rate is known in closed form;
scikit-image's samples where it is installed; and photographs of a folder, whose own board is
painted over. A candidate is a quadrilateral whose bits were read, accepted or not; of random bits
each square.

Usage: rates.py [IMAGES] [FOLDER=DICTIONARY ...]
"""

import math
import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.stats import beta

ARUCO = cv2.aruco
DICTIONARIES = ("4X4_50", "4X4_1000", "5X5_100", "6X6_250", "7X7_1000", "APRILTAG_16h5",
                "APRILTAG_25h9", "APRILTAG_36h11", "ARUCO_ORIGINAL", "ARUCO_MIP_36h12")
RATES = (0.0, 0.3, 0.6, 1.0)
SIZE, SQUARE_PX, SQUARES = (480, 640), 50, 40


def dictionary_of(name):
    return ARUCO.getPredefinedDictionary(getattr(ARUCO, f"DICT_{name}"))


def noise(generator):
    """Return normal noise that is correlated over 0.5 to 6 px, with a spread of 60 grey levels."""
    image = cv2.GaussianBlur(generator.normal(size=SIZE), (0, 0), generator.uniform(0.5, 6))
    return np.clip(128 + 60 * image / image.std(), 0, 255).astype(np.uint8)


def rectangles(generator):
    """Return 150 rectangles of random greys, sides of 10 to 120 px and directions."""
    image = np.full(SIZE, 200, np.uint8)
    for _ in range(150):
        box = (generator.uniform(0, SIZE[::-1]), generator.uniform(10, 120, 2),
               generator.uniform(0, 90))
        cv2.fillConvexPoly(image, cv2.boxPoints(box).astype(np.int32),
                           int(generator.integers(0, 256)))
    return image


def random_codes(generator, bits):
    """Return 40 squares with a black border and random bits inside."""
    image = np.full(SIZE, 255, np.uint8)
    for row in range(5):
        for column in range(8):
            code = np.zeros((bits + 2, bits + 2), np.uint8)
            code[1:-1, 1:-1] = 255 * generator.integers(0, 2, (bits, bits))
            top, left = 20 + 92 * row, 18 + 78 * column
            image[top : top + SQUARE_PX, left : left + SQUARE_PX] = cv2.resize(
                code, (SQUARE_PX, SQUARE_PX), interpolation=cv2.INTER_NEAREST)
    return image


def photographs(folder, board):
    """Return a folder's photographs, each with what its board's markers span painted over."""
    images = []
    for path in sorted(Path(folder).rglob("*.[jp][pn]g")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        corners, _, _ = ARUCO.ArucoDetector(dictionary_of(board)).detectMarkers(image)
        if corners:
            hull = cv2.convexHull(np.concatenate(corners).reshape(-1, 2)).reshape(-1, 2)
            hull = hull.mean(axis=0) + 1.5 * (hull - hull.mean(axis=0))
            cv2.fillConvexPoly(image, hull.astype(np.int32), int(image.mean()))
            images.append(image)
    return images


def samples():
    """Return scikit-image's own pictures; none where it is not installed."""
    try:
        from skimage import data  # noqa: PLC0415  (not everywhere installed)
    except ModuleNotFoundError:
        return []
    names = ("astronaut", "brick", "camera", "coffee", "coins", "grass", "gravel", "page", "text")
    found = [getattr(data, name)() for name in names]
    return [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) if each.ndim == 3 else each for each in found]


def count(images, dictionary, rate):
    """Return the false markers and the candidates of images."""
    parameters = ARUCO.DetectorParameters()
    parameters.errorCorrectionRate = rate
    detector = ARUCO.ArucoDetector(dictionary, parameters)
    found = [detector.detectMarkers(image) for image in images]
    false = sum(len(corners) for corners, _, _ in found)
    return false, false + sum(len(rejected) for _, _, rejected in found)


def closed_form(dictionary, rate):
    """Return the probability that random bits lie within the corrected distance of a code."""
    bits = dictionary.markerSize**2
    corrected = int(dictionary.maxCorrectionBits * rate)
    near = sum(math.comb(bits, k) for k in range(corrected + 1))
    return min(4 * len(dictionary.bytesList) * near / 2**bits, 1.0)


def interval(false, candidates):
    """Return the ends of the exact 95 % interval (Clopper and Pearson, 1934)."""
    low = beta.ppf(0.025, false, candidates - false + 1) if false else 0.0
    high = beta.ppf(0.975, false + 1, candidates - false) if false < candidates else 1.0
    return low, high


def main(arguments):
    images = int(next((each for each in arguments if each.isdigit()), 100))
    generator = np.random.default_rng(40)
    sets = {"noise": [noise(generator) for _ in range(images)],
            "rectangles": [rectangles(generator) for _ in range(images)]}
    if pictures := samples():
        sets["samples"] = pictures
    for folder, board in (each.split("=") for each in arguments if "=" in each):
        sets[Path(folder).name] = photographs(folder, board)
    print("| dictionary | rate | corrected bits | "
          + " | ".join(f"{name}: false of candidates, 1 in 1,000" for name in sets)
          + " | random bits: false of squares, 1 in 1,000 | closed form |")
    print("| --- | --- | --- | " + "--- | " * (len(sets) + 2))
    for name in DICTIONARIES:
        dictionary = dictionary_of(name)
        codes = [random_codes(generator, dictionary.markerSize) for _ in range(images)]
        for rate in RATES:
            row = [name, f"{rate:g}", str(int(dictionary.maxCorrectionBits * rate))]
            for shown in (*sets.values(), codes):
                false, candidates = count(shown, dictionary, rate)
                candidates = SQUARES * images if shown is codes else candidates
                low, high = interval(false, candidates)
                row.append(f"{false} of {candidates}: {1000 * low:.3g} to {1000 * high:.3g}")
            row.append(f"{1000 * closed_form(dictionary, rate):.3g}")
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
