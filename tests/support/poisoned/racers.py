"""Processes that race for the lock of a store, again and again; prints how many had it each time.

Arguments: the store, the number of processes, the number of tries, and what they find: "nothing",
or the lock of a "dead" process. Whoever gets the lock holds it until all have an answer.
"""

import json
import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from sweep.errors import StoreError
from sweep.store.lifecycle import open_store
from sweep.store.lock import KEY, locked

SEED = 7


def racer(url, number, come, go):
    """Try for the lock whenever a byte comes; answer whether it was got, and wait for another."""
    store = open_store(url, "r+")
    draw = random.Random(SEED + number)
    while os.read(come, 1):
        time.sleep(draw.choice((0.0, 0.0, 0.0005 * draw.random())))
        try:
            with locked(store):
                os.write(go, b"1")
                os.read(come, 1)
        except StoreError:
            os.write(go, b"0")
            os.read(come, 1)


def dead_lock(url):
    """Return the lock of a process that was killed."""
    script = (
        "import os, sys; from sweep.store.lifecycle import open_store; "
        "from sweep.store.lock import locked; held = locked(open_store(sys.argv[1], 'r+')); "
        "held.__enter__(); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", script, url], check=False)
    lock = Path(url, KEY)
    content = lock.read_bytes()
    lock.unlink()
    return content


def main():
    url, count, tries, finds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
    lock = Path(url, KEY)
    stale = dead_lock(url) if finds == "dead" else None
    pipes = []
    for number in range(count):
        (come, to), (answer, go) = os.pipe(), os.pipe()
        if os.fork() == 0:
            for pipe in pipes:
                os.close(pipe[0])
            os.close(to)
            racer(url, number, come, go)
            os._exit(0)
        pipes.append((to, answer))
    holders = Counter()
    for _ in range(tries):
        if stale is not None:
            lock.write_bytes(stale)
        for to, _ in pipes:
            os.write(to, b".")
        holders[sum(os.read(answer, 1) == b"1" for _, answer in pipes)] += 1
        for to, _ in pipes:
            os.write(to, b".")
        deadline = time.monotonic() + 10
        while lock.exists() and time.monotonic() < deadline:
            time.sleep(0.0005)
        if lock.exists():
            holders["left"] += 1
    for to, _ in pipes:
        os.close(to)
    print(json.dumps(holders))


if __name__ == "__main__":
    main()
