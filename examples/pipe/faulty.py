#!/usr/bin/env python3
"""springs.py with a fault, for tests: `faulty.py hang|die|nan|size once|always FILE`.

While FILE exists, one step in five (chosen by its bytes) goes wrong; with `once` FILE is removed
first, so that only one step ever does.
"""

import os
import struct
import sys
import time
import zlib

import springs

FAULT, HOW_OFTEN, FILE = sys.argv[1:4]


def answer(simulator, payload):
    right = springs.answer(simulator, payload)
    if not os.path.exists(FILE) or zlib.crc32(payload) % 5:
        return right
    if HOW_OFTEN == "once":
        os.remove(FILE)
    if FAULT == "hang":
        time.sleep(3600)
    if FAULT == "die":
        os._exit(3)
    if FAULT == "nan":
        return struct.pack("<f", float("nan")) + right[4:]
    return right[:-4]


springs.main(answer)
