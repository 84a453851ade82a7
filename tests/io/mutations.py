"""Damages files as disks, networks and attackers do, from a seed: the inputs of `test_fuzz.py`."""

import copy
import json
import random
import re
import struct

WORDS = [0, 1, 2, 3, 7, 127, 128, 255, 256, 32767, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40]
WORDS += [2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1]
FLOATS = [float("nan"), float("inf"), float("-inf"), 3e38, -3e38, 1e-45, 0.0, -0.0]
NUMBERS = [b"0", b"-1", b"1", b"99999999999", b"nan", b"1e999", b"-0", b"1e38", b"4294967296", b"", b"null"]
NUMBERS += [b"[]", b'"a"', b"65536", b"9" * 400]
VALUES = [None, True, False, 0, -1, 1, 3, 1e308, 1e-320, float("nan"), float("inf"), 2**31, 2**63, 10**400]
VALUES += ["", "a", ".", "../../etc/passwd", "/etc/passwd", "a\0b", "\ud800", "\x1b[31m", "x" * 5000, "NaN"]
VALUES += [[], [[]], {}, [1], [1, 2, 3], [[1, 2], [3]], {"a": 1}, [0] * 1000, [None] * 3, ["a", "b"]]


def damaged(rng: random.Random, contents: bytes, others: list[bytes]) -> bytes:
    """Returns the contents with one to five changes, more of them near the beginning, where headers are."""
    result = bytearray(contents)
    for _ in range(rng.choice([1, 1, 1, 2, 3, 5])):
        if not result:
            break
        region = len(result) if rng.random() < 0.5 else min(len(result), rng.choice([16, 64, 256, 2048]))
        rng.choice(CHANGES)(rng, result, rng.randrange(region), others)
    return bytes(result)


def flip(rng, contents, at, others):
    contents[at] ^= 1 << rng.randrange(8)


def byte(rng, contents, at, others):
    contents[at] = rng.choice([0, 255, 127, 128, 1, 0x20, 0x0A, 0x22, 0x2D, 0x39])


def word(rng, contents, at, others):
    width = rng.choice([1, 2, 4, 8])
    value = rng.choice(WORDS) & ((1 << 8 * width) - 1)
    contents[at : at + width] = value.to_bytes(width, rng.choice(["little", "big"]))


def real(rng, contents, at, others):
    kind = rng.choice(["<f", "<d"])
    contents[at : at + struct.calcsize(kind)] = struct.pack(kind, rng.choice(FLOATS))


def cut(rng, contents, at, others):
    del contents[at:]


def remove(rng, contents, at, others):
    del contents[at : at + rng.randrange(1, 64)]


def insert(rng, contents, at, others):
    contents[at:at] = rng.randbytes(rng.randrange(1, 32))


def repeat(rng, contents, at, others):
    contents[at:at] = contents[at : at + rng.randrange(1, 64)] * rng.choice([1, 2, 50])


def splice(rng, contents, at, others):
    other = rng.choice(others)
    start = rng.randrange(len(other) + 1)
    piece = other[start : start + rng.randrange(1, 200)]
    contents[at : at + len(piece)] = piece


def number(rng, contents, at, others):
    if found := list(re.finditer(rb"-?\d+(\.\d+)?", bytes(contents[:4000]))):
        match = rng.choice(found)
        contents[match.start() : match.end()] = rng.choice(NUMBERS)


CHANGES = (flip, byte, word, real, cut, remove, insert, repeat, splice, number)


def damaged_json(rng: random.Random, contents: bytes) -> bytes:
    """Returns JSON with one to four entries replaced, removed, added, or copied from elsewhere."""
    whole = json.loads(contents)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        places = list(places_in(whole))
        if not places:
            break
        holder, key = rng.choice(places)
        change = rng.randrange(6)
        if change <= 2:
            holder[key] = copy.deepcopy(rng.choice(VALUES))
        elif change == 3:
            del holder[key]
        elif change == 4:
            source, other = rng.choice(places)
            holder[key] = copy.deepcopy(source[other])
        elif isinstance(holder, list):
            holder.insert(key, copy.deepcopy(rng.choice(VALUES)))
        else:
            _, name = rng.choice(places)
            holder[str(name)] = copy.deepcopy(rng.choice(VALUES))
    return json.dumps(whole).encode("utf-8", "surrogatepass")


def places_in(value):
    """Yields (dict or list, key) of all entries, of long lists the first 40."""
    keys = value.keys() if isinstance(value, dict) else range(min(len(value), 40))
    for key in list(keys):
        yield value, key
        if isinstance(value[key], dict | list):
            yield from places_in(value[key])
