"""The numbers that both sides make for themselves: every value follows from a name and an index.

Integers up to one division by 2^32, so any language gets the same bits; see README.md for the definition in words.
"""

import numpy as np


def fnv1a(name):
    """FNV-1a, 32 bits, of the UTF-8 bytes of a name."""
    h = 0x811C9DC5
    for byte in name.encode("utf-8"):
        h = ((h ^ byte) * 0x01000193) & 0xFFFFFFFF
    return h


def hashed(name, count):
    """`count` hashed 32-bit integers (as uint64) for the flat indices 0, 1, 2, ..."""
    mask = np.uint64(0xFFFFFFFF)
    h = (np.arange(count, dtype=np.uint64) * np.uint64(0x9E3779B1) + np.uint64(fnv1a(name))) & mask
    h ^= h >> np.uint64(16)
    h = (h * np.uint64(0x7FEB352D)) & mask
    h ^= h >> np.uint64(15)
    h = (h * np.uint64(0x846CA68B)) & mask
    h ^= h >> np.uint64(16)
    return h


def unit(name, shape):
    """Float64 values in [-1, 1), in row-major order of `shape`."""
    count = int(np.prod(shape))
    return (hashed(name, count).astype(np.float64) / 2.0**32 * 2.0 - 1.0).reshape(shape)
