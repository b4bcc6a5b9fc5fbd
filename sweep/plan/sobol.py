"""Sobol' points, scrambled: draws of several quantities that fill their space evenly.

Points are those of Sobol' (USSR Computational Mathematics and Mathematical Physics 7(4), 1967) with
the direction numbers of Joe and Kuo ("Constructing Sobol sequences with better two-dimensional
projections", SIAM Journal on Scientific Computing 30(5), 2008; their file new-joe-kuo-6.21201), in
the order of Antonov and Saleev's Gray code. They are randomised by Owen's nested uniform scrambling
("Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995): each binary digit is flipped by a
random bit that depends on the digits before it. So each point is uniform, and replicates with
scrambles of their own are independent.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from sweep.model.splitmix import mixed
from sweep.typing import Floats, Integers

REPLICATES = 16
"""Independent randomisations; the trial modulo this is the number of a trial's replicate."""

BITS = 32
"""Binary digits of a point; those beyond are random."""

_NUMBERS = (
    (3, 1), (7, 1, 3), (11, 1, 3, 1), (13, 1, 1, 1), (19, 1, 1, 3, 3), (25, 1, 3, 5, 13),
    (37, 1, 1, 5, 5, 17), (41, 1, 1, 5, 5, 5), (47, 1, 1, 7, 11, 19), (55, 1, 1, 5, 1, 1),
    (59, 1, 1, 1, 3, 11), (61, 1, 3, 5, 5, 31), (67, 1, 3, 3, 9, 7, 49),
    (91, 1, 1, 1, 15, 21, 21), (97, 1, 3, 1, 13, 27, 49), (103, 1, 1, 1, 15, 7, 5),
    (109, 1, 3, 1, 15, 13, 25), (115, 1, 1, 5, 5, 19, 61), (131, 1, 3, 7, 11, 23, 15, 103),
    (137, 1, 3, 7, 13, 13, 15, 69), (143, 1, 1, 3, 13, 7, 35, 63), (145, 1, 3, 5, 9, 1, 25, 53),
    (157, 1, 3, 1, 13, 9, 35, 107), (167, 1, 3, 1, 5, 27, 61, 31), (171, 1, 1, 5, 11, 19, 41, 61),
    (185, 1, 3, 5, 3, 3, 13, 69), (191, 1, 1, 7, 13, 1, 19, 1), (193, 1, 3, 7, 5, 13, 19, 59),
    (203, 1, 1, 3, 9, 25, 29, 41), (211, 1, 3, 5, 13, 23, 1, 55), (213, 1, 3, 7, 3, 13, 59, 17),
    (229, 1, 3, 1, 3, 5, 53, 69), (239, 1, 1, 5, 5, 23, 33, 13), (241, 1, 1, 7, 7, 1, 61, 123),
    (247, 1, 1, 7, 9, 13, 61, 49), (253, 1, 3, 3, 5, 3, 55, 33),
    (285, 1, 3, 1, 15, 31, 13, 49, 245), (299, 1, 3, 5, 15, 31, 59, 63, 97),
    (301, 1, 3, 1, 11, 11, 11, 77, 249), (333, 1, 3, 1, 11, 27, 43, 71, 9),
    (351, 1, 1, 7, 15, 21, 11, 81, 45), (355, 1, 3, 7, 3, 25, 31, 65, 79),
    (357, 1, 3, 1, 1, 19, 11, 3, 205), (361, 1, 1, 5, 9, 19, 21, 29, 157),
    (369, 1, 3, 7, 11, 1, 33, 89, 185), (391, 1, 3, 3, 3, 15, 9, 79, 71),
    (397, 1, 3, 7, 11, 15, 39, 119, 27), (425, 1, 1, 3, 1, 11, 31, 97, 225),
    (451, 1, 1, 1, 3, 23, 43, 57, 177), (463, 1, 3, 7, 7, 17, 17, 37, 71),
    (487, 1, 3, 1, 5, 27, 63, 123, 213), (501, 1, 1, 3, 5, 11, 43, 53, 133),
    (529, 1, 3, 5, 5, 29, 17, 47, 173, 479), (539, 1, 3, 3, 11, 3, 1, 109, 9, 69),
    (545, 1, 1, 1, 5, 17, 39, 23, 5, 343), (557, 1, 3, 1, 5, 25, 15, 31, 103, 499),
    (563, 1, 1, 1, 11, 11, 17, 63, 105, 183), (601, 1, 1, 5, 11, 9, 29, 97, 231, 363),
    (607, 1, 1, 5, 15, 19, 45, 41, 7, 383), (617, 1, 3, 7, 7, 31, 19, 83, 137, 221),
    (623, 1, 1, 1, 3, 23, 15, 111, 223, 83), (631, 1, 1, 5, 13, 31, 15, 55, 25, 161),
    (637, 1, 1, 3, 13, 25, 47, 39, 87, 257), (647, 1, 1, 1, 11, 21, 53, 125, 249, 293),
    (661, 1, 1, 7, 11, 11, 7, 57, 79, 323), (675, 1, 1, 5, 5, 17, 13, 81, 3, 131),
    (677, 1, 1, 7, 13, 23, 7, 65, 251, 475), (687, 1, 3, 5, 1, 9, 43, 3, 149, 11),
    (695, 1, 1, 3, 13, 31, 13, 13, 255, 487), (701, 1, 3, 3, 1, 5, 63, 89, 91, 127),
    (719, 1, 1, 3, 3, 1, 19, 123, 127, 237), (721, 1, 1, 5, 7, 23, 31, 37, 243, 289),
    (731, 1, 1, 5, 11, 17, 53, 117, 183, 491), (757, 1, 1, 1, 5, 1, 13, 13, 209, 345),
    (761, 1, 1, 3, 15, 1, 57, 115, 7, 33), (787, 1, 3, 1, 11, 7, 43, 81, 207, 175),
    (789, 1, 3, 1, 1, 15, 27, 63, 255, 49), (799, 1, 3, 5, 3, 27, 61, 105, 171, 305),
    (803, 1, 1, 5, 3, 1, 3, 57, 249, 149),
    (817, 1, 1, 3, 5, 5, 57, 15, 13, 159), (827, 1, 1, 1, 11, 7, 11, 105, 141, 225),
    (847, 1, 3, 3, 5, 27, 59, 121, 101, 271), (859, 1, 3, 5, 9, 11, 49, 51, 59, 115),
    (865, 1, 1, 7, 1, 23, 45, 125, 71, 419), (875, 1, 1, 3, 5, 23, 5, 105, 109, 75),
    (877, 1, 1, 7, 15, 7, 11, 67, 121, 453), (883, 1, 3, 7, 3, 9, 13, 31, 27, 449),
    (895, 1, 3, 1, 15, 19, 39, 39, 89, 15), (901, 1, 1, 1, 1, 1, 33, 73, 145, 379),
    (911, 1, 3, 1, 15, 15, 43, 29, 13, 483), (949, 1, 1, 7, 3, 19, 27, 85, 131, 431),
    (953, 1, 3, 3, 3, 5, 35, 23, 195, 349), (967, 1, 3, 3, 7, 9, 27, 39, 59, 297),
    (971, 1, 1, 3, 9, 11, 17, 13, 241, 157), (973, 1, 3, 7, 15, 25, 57, 33, 189, 213),
    (981, 1, 1, 7, 1, 9, 55, 73, 83, 217), (985, 1, 3, 3, 13, 19, 27, 23, 113, 249),
    (995, 1, 3, 5, 3, 23, 43, 3, 253, 479), (1001, 1, 1, 5, 5, 11, 5, 45, 117, 217),
)
"""Of each dimension after the first: the bits of its primitive polynomial, and m_1, m_2, ..."""

DIMENSIONS = len(_NUMBERS) + 1
"""The most quantities that can be drawn together."""

_STEP = np.uint64(0x9E3779B97F4A7C15)
_ONE = np.uint64(1)


@cache
def directions(dimension: int) -> tuple[int, ...]:
    """Return the direction numbers (:data:`BITS`,) of a dimension from 0, as fractions of 2^32.

    Joe and Kuo 2008, section 2, equations 2 and 3.
    """
    if dimension == 0:
        numbers = [1] * BITS
    else:
        polynomial, *numbers = _NUMBERS[dimension - 1]
        degree = polynomial.bit_length() - 1
        for k in range(degree, BITS):
            number = numbers[k - degree] ^ (numbers[k - degree] << degree)
            for j in range(1, degree):
                if polynomial >> (degree - j) & 1:
                    number ^= numbers[k - j] << j
            numbers.append(number)
    return tuple(number << (BITS - 1 - k) for k, number in enumerate(numbers))


def points(dimension: int, index: Integers) -> NDArray[np.uint64]:
    """Return the points (N,) of a dimension at indices (N,) of the sequence, times 2^32."""
    index = np.asarray(index, dtype=np.uint64)
    gray = index ^ (index >> _ONE)
    found = np.zeros(index.shape, dtype=np.uint64)
    highest = int(gray.max(initial=0)).bit_length()
    for k, direction in enumerate(directions(dimension)[:highest]):
        bit = (gray >> np.uint64(k)) & _ONE
        found ^= bit * np.uint64(direction)
    return found


def scrambled(digits: NDArray[np.uint64], keys: NDArray[np.uint64]) -> Floats:
    """Return points (N,) of :data:`BITS` digits, scrambled by keys (N,), as numbers in (0, 1).

    A digit is flipped by a random bit of the key and the digits before it; those beyond the last
    are random bits of the key and all digits. 53 in all, in the middle of their interval.
    """
    result = np.zeros(digits.shape, dtype=np.uint64)
    for k in range(BITS):
        # The digits before it, and their number, so that prefixes of any length differ.
        prefix = (digits >> np.uint64(BITS - k)) | np.uint64((k + 1) << BITS)
        flip = mixed(keys ^ mixed(prefix)) >> np.uint64(63)
        digit = (digits >> np.uint64(BITS - 1 - k)) & _ONE
        result = (result << _ONE) | (digit ^ flip)
    rest = mixed(keys ^ mixed(digits | np.uint64((BITS + 1) << BITS)))
    result = (result << np.uint64(53 - BITS)) | (rest >> np.uint64(64 - (53 - BITS)))
    return np.asarray((result + 0.5) * 2.0**-53)


def sobol_uniform(
    dimension: int, keys: NDArray[np.uint64], trials: Integers
) -> Floats:
    """Return uniform numbers in (0, 1) of scenes, (N,), evenly spread over the trials.

    Parameters
    ----------
    dimension
        Number of the quantity among those that are drawn.
    keys
        (N,) random bits of the seed, the quantity and the scene's geometry, not of its trial.
    trials
        (N,) trial ``t`` is point ``t // 16`` of replicate ``t % 16``, whatever other trials exist.
    """
    index, replicate = np.divmod(np.asarray(trials, dtype=np.uint64), np.uint64(REPLICATES))
    own = mixed(keys + _STEP * (replicate + _ONE))
    return scrambled(points(dimension, index), own)
