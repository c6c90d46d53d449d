"""Outside references on states exported by `toile codec bench STORE --export DIR`.

    python3 -m venv /tmp/peers && /tmp/peers/bin/pip install numpy pysz zfpy pcodec constriction
    /tmp/peers/bin/python codec/peers/outside.py DIR --max-mm 90.0 --rms-mm 12.4

SZ3 and zfp code the states themselves, a region at a time (so that each decodes on its own), once
within --max-mm and once to --rms-mm. pco and constriction's range coder code the rounded
coefficients that our own range coder codes, after the same kind of prediction in time.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np


def load(folder):
    shape = json.loads((folder / "shape.json").read_text())
    vertices, regions = shape["vertices"], np.array(shape["regions"])
    states = np.memmap(folder / "states.f32", "<f4", "r").reshape(-1, vertices, 3)
    steps = np.fromfile(folder / "steps.i32", "<i4").reshape(len(states), shape["columns"])
    first = np.concatenate([[0], np.cumsum(regions)[:-1]])
    return shape, states, steps, list(zip(first, regions))


def chain(points):
    """Vertices in an order in which neighbours in the list are neighbours in space: what a mesh
    file does not promise, and coders of regular grids live from."""
    left = np.ones(len(points), bool)
    order = [0]
    for _ in range(len(points) - 1):
        left[order[-1]] = False
        distance = ((points - points[order[-1]]) ** 2).sum(axis=1)
        order.append(int(np.where(left, distance, np.inf).argmin()))
    return np.array(order)


def sz3(block, bound):
    import pysz

    config = pysz.szConfig(block.shape)
    config.errorBoundMode = pysz.szErrorBoundMode.ABS
    config.absErrorBound = bound
    start = time.process_time()
    packed, _ = pysz.sz.compress(block, config)
    coded = time.process_time()
    back, _ = pysz.sz.decompress(packed, np.float32, block.shape)
    return len(packed), back, coded - start, time.process_time() - coded


def zfp(block, bound):
    import zfpy

    start = time.process_time()
    packed = zfpy.compress_numpy(block, tolerance=bound)
    coded = time.process_time()
    back = zfpy.decompress_numpy(packed)
    return len(packed), back, coded - start, time.process_time() - coded


def over(coder, states, order, regions, bound):
    size, seconds, count, square, largest, vertices = 0, [0.0, 0.0], 0, 0.0, 0.0, 0
    for first, length in regions:
        # Axis by axis: states x vertices is the grid.
        block = np.ascontiguousarray(states[first : first + length][:, order].transpose(2, 0, 1))
        packed, back, encode, decode = coder(block, bound)
        error = ((block.astype("f8") - back) ** 2).sum(axis=0)
        size += packed
        seconds = [seconds[0] + encode, seconds[1] + decode]
        square += error.sum()
        vertices += error.size
        largest = max(largest, error.max())
        count += length
    return {
        "bytes_per_frame": float(size / count),
        "max_mm": float(1e3 * largest**0.5),
        "rms_mm": float(1e3 * (square / vertices) ** 0.5),
        "encode_ms": float(1e3 * seconds[0] / count),
        "decode_us": float(1e6 * seconds[1] / count),
    }


def within(coder, states, order, regions, key, wanted):
    """The coarsest bound that keeps to `wanted` in `key`, to a percent or two."""
    low, high = wanted / 1e4, wanted / 1e2
    best = None
    for _ in range(9):
        bound = (low * high) ** 0.5
        row = over(coder, states, order, regions, bound)
        if row[key] <= wanted:
            low, best = bound, row
        else:
            high = bound
    return best


def predicted(block, factors):
    """What is left of each column by two states before, rounded; factors as floats."""
    left = block.astype("i8").copy()
    one, two = factors
    if len(block) > 1:
        left[1] -= np.rint(one[0] * block[0]).astype("i8")
    if len(block) > 2:
        left[2:] -= np.rint(two[0] * block[1:-1] + two[1] * block[:-2]).astype("i8")
    return left


def factors_of(steps, regions):
    xy, yy = 0.0, 1e-9
    a = np.zeros((5, steps.shape[1]))
    for first, length in regions:
        block = steps[first : first + length].astype("f8")
        if length > 1:
            xy += block[1] * block[0]
            yy += block[0] ** 2
        if length > 2:
            x, y, z = block[2:], block[1:-1], block[:-2]
            products = [x * y, x * z, y * y, y * z, z * z]
            a += np.stack([p.sum(axis=0) for p in products])
    lxy, lxz, lyy, lyz, lzz = a
    lyy, lzz = lyy + 1e-6, lzz + 1e-6
    det = lyy * lzz - lyz**2 + 1e-9
    return (xy / yy,), ((lxy * lzz - lxz * lyz) / det, (lxz * lyy - lxy * lyz) / det)


def coders(steps, regions):
    import constriction
    from pcodec import standalone, ChunkConfig

    factors = factors_of(steps, regions)
    left = [predicted(steps[first : first + length], factors) for first, length in regions]
    scale = np.maximum(np.mean([np.abs(l).mean(axis=0) for l in left], axis=0), 0.05)
    states = sum(length for _, length in regions)
    rows = []
    config = ChunkConfig()
    start = time.process_time()
    packed = [standalone.simple_compress(l.T.astype("i4").ravel(), config) for l in left]
    coded = time.process_time()
    for p in packed:
        standalone.simple_decompress(p)
    decoded = time.process_time()
    rows.append(("pco", sum(map(len, packed)), coded - start, decoded - coded))
    family = constriction.stream.model.QuantizedLaplace(-(1 << 20), 1 << 20)
    size, encode, decode = 0, 0.0, 0.0
    for l in left:
        message = l.T.astype("i4").ravel()
        spread = np.repeat(scale, len(l)).astype("f8")
        middle = np.zeros(len(message))
        start = time.process_time()
        coder = constriction.stream.queue.RangeEncoder()
        coder.encode(message, family, middle, spread)
        packed = coder.get_compressed()
        coded = time.process_time()
        back = constriction.stream.queue.RangeDecoder(packed).decode(family, middle, spread)
        decode += time.process_time() - coded
        encode += coded - start
        size += 4 * len(packed)
        assert (back == message).all()
    rows.append(("constriction-range-laplace", size, encode, decode))
    return [
        {
            "name": name,
            "bytes_per_frame": float(size / states),
            "encode_ms": float(1e3 * encode / states),
            "decode_us": float(1e6 * decode / states),
        }
        for name, size, encode, decode in rows
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--max-mm", type=float, required=True)
    parser.add_argument("--rms-mm", type=float, required=True)
    parser.add_argument("--every", type=int, default=40, help="every so many regions for SZ3, zfp")
    a = parser.parse_args()
    shape, states, steps, regions = load(a.folder)
    sample = regions[:: a.every]
    order = chain(np.array(states[0]))
    out = {"states": len(states), "sampled": int(sum(n for _, n in sample)), "codecs": []}
    for name, coder in (("sz3", sz3), ("zfp", zfp)):
        for key, wanted in (("max_mm", a.max_mm), ("rms_mm", a.rms_mm)):
            row = within(coder, states, order, sample, key, wanted)
            out["codecs"].append({"name": f"{name}-equal-{key[:3]}", **row})
            print(out["codecs"][-1], flush=True)
    ours = shape["toile_bytes"] / len(states)
    out["coefficients"] = [{"name": "toile", "bytes_per_frame": ours}] + coders(steps, regions)
    for row in out["coefficients"]:
        print(row, flush=True)
    print(json.dumps(out))


if __name__ == "__main__":
    main()
