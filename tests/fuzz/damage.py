# SPDX-License-Identifier: GPL-3.0-or-later
"""How files are damaged, how often, and what must not come of it."""

import contextlib
import json
import random
import signal
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

MANY = 100_000  # cases of --slow, over all suites in proportion
FEW = 700  # of the default run
SEEDS = st.integers(0, 2**48)
_WORDS = [struct.pack("<f", x) for x in (float("nan"), float("inf"), -float("inf"), 1e-42, -0.0, 3.4e38, -3.4e38)]
_WORDS += [struct.pack("<I", x) for x in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x00FFFFFF)]
_WORDS += [struct.pack("<Q", x) for x in (0xFFFFFFFFFFFFFFFF, 1 << 40)]
_LEAVES = [
    None,
    True,
    0,
    -1,
    1,
    0.5,
    -0.5,
    1e-300,
    1e300,
    2**31,
    2**63,
    float("nan"),
    float("inf"),
    "",
    "x",
    "0",
    "../x",
]
_LEAVES += [[], [0], {}, [[]], [None], {"a": 1}, "\0", "é" * 40]


def suite(check, cases: int):
    """A test that calls check(seed) for `cases` seeds, and one of --slow with as many more as MANY is of FEW; the same
    seeds on every run."""

    def short(seed):
        check(seed)

    def long(seed):
        check(seed)

    short = settings(max_examples=cases)(given(seed=SEEDS)(short))
    long = settings(max_examples=cases * MANY // FEW)(given(seed=SEEDS)(long))
    return short, pytest.mark.slow(long)


def damaged(data: bytes, r: random.Random, head: int = 400) -> bytes:
    """A copy that is cut off, longer, or has bits, bytes or words that are not as they were; half of them in the first
    `head` bytes, where files say what they are."""
    b = bytearray(data)
    if r.random() < 0.25:
        del b[r.randrange(len(b) + 1) :]
    elif r.random() < 0.1:
        b += r.randbytes(r.randrange(1, 64))
    for _ in range(r.choice((0, 1, 1, 2, 4, 30))):
        if len(b) < 9:
            break
        at = r.randrange(min(head, len(b) - 8)) if r.random() < 0.5 else r.randrange(len(b) - 8)
        kind = r.randrange(4)
        if kind == 0:
            b[at] ^= 1 << r.randrange(8)
        elif kind == 1:
            b[at] = r.randrange(256)
        elif kind == 2:
            word = r.choice(_WORDS)
            at -= at % 4
            b[at : at + len(word)] = word
        else:
            other = r.randrange(len(b) - 8)
            b[at : at + 8] = b[other : other + 8]
    return bytes(b)


def damaged_json(text: str, r: random.Random) -> str:
    """The same document with some entries replaced, left out or doubled; or its text damaged."""
    if r.random() < 0.2:
        return damaged(text.encode(), r, len(text)).decode("utf-8", errors="replace")
    document = json.loads(text)
    for _ in range(r.choice((1, 1, 1, 2, 5))):
        places = []

        def walk(node, places=places):
            for key in list(node) if isinstance(node, dict) else range(len(node)):
                places.append((node, key))
                if isinstance(node[key], dict | list):
                    walk(node[key])

        if isinstance(document, dict | list):
            walk(document)
        if not places:
            break
        node, key = r.choice(places)
        if r.random() < 0.2:
            del node[key]
        else:
            node[key] = json.loads(json.dumps(r.choice(_LEAVES)))
    return json.dumps(document)


@contextlib.contextmanager
def no_hang(seconds: int = 20):
    """An error inside where it has not come to an end after so many seconds of the processor."""
    if not hasattr(signal, "SIGPROF"):
        yield
        return

    def stop(*_):
        raise TimeoutError(f"it hangs: {seconds} s are over")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def is_a_sentence(error: Exception, path) -> None:
    """One line that begins with the file, or one below it."""
    said = str(error)
    assert said.startswith(str(path)) and "\n" not in said and len(said) < 1500, said
