#!/usr/bin/env python3
"""A simulator for Toile in Python, without any library: every vertex hangs on a damped spring from
the place to which the nearest joint carries it. Not good cloth, but a whole simulator: see
docs/pipe.md for the protocol.

    [simulator]
    command = ["python3", "springs.py"]
"""

import json
import struct
import sys

HELLO, READY, STEP, STATE, FAILED = 1, 2, 3, 4, 5
STIFFNESS = 400.0  # 1/s^2
DAMPING = 12.0  # 1/s
GRAVITY = -9.81  # m/s^2
SUBSTEPS = 4


def receive(stream):
    head = stream.read(5)
    if len(head) < 5:
        return None, b""
    length, kind = struct.unpack("<IB", head)
    return kind, stream.read(length)


def send(stream, kind, payload=b""):
    stream.write(struct.pack("<IB", len(payload), kind) + payload)
    stream.flush()


def rotate(q, v):
    """v turned by the unit quaternion q = (x, y, z, w)."""
    x, y, z, w = q
    tx = 2 * (y * v[2] - z * v[1])
    ty = 2 * (z * v[0] - x * v[2])
    tz = 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


class Springs:
    def __init__(self, hello):
        self.frame_s = hello["frame_s"]
        self.ground = hello["ground"]
        self.rest = [(tuple(r[:3]), tuple(r[3:])) for r in hello["body"]["rest"]]
        self.attached = set(hello["garment"]["attached"])
        self.joint, self.local = [], []
        for p in hello["garment"]["positions"]:
            joint = min(range(len(self.rest)), key=lambda j: squared(self.rest[j][0], p))
            place, (x, y, z, w) = self.rest[joint]
            self.joint.append(joint)
            self.local.append(rotate((-x, -y, -z, w), [a - b for a, b in zip(p, place)]))

    def carried(self, joints, vertex):
        place, turn = joints[self.joint[vertex]]
        return [a + b for a, b in zip(rotate(turn, self.local[vertex]), place)]

    def step(self, before, after, positions, velocities):
        for vertex in range(len(positions)):
            a, b = self.carried(before, vertex), self.carried(after, vertex)
            if vertex in self.attached:
                velocities[vertex] = [(y - x) / self.frame_s for x, y in zip(a, b)]
                positions[vertex] = b
                continue
            p, v = positions[vertex], velocities[vertex]
            dt = self.frame_s / SUBSTEPS
            for sub in range(1, SUBSTEPS + 1):
                t = sub / SUBSTEPS
                for axis in range(3):
                    target = a[axis] + (b[axis] - a[axis]) * t
                    pull = STIFFNESS * (target - p[axis]) + (GRAVITY if axis == 1 else 0.0)
                    # Implicit in the damping and the spring: stable whatever they are.
                    v[axis] = (v[axis] + dt * pull) / (1 + dt * DAMPING + dt * dt * STIFFNESS)
                    p[axis] += dt * v[axis]
                if self.ground and p[1] < 0.0:
                    p[1], v[1] = 0.0, 0.0


def squared(a, b):
    return sum((x - y) ** 2 for x, y in zip(a, b))


def rows(values, width):
    return [list(values[i : i + width]) for i in range(0, len(values), width)]


def answer(simulator, payload):
    joints, vertices = len(simulator.rest), len(simulator.local)
    values = struct.unpack(f"<{14 * joints + 6 * vertices}f", payload)
    poses = [(tuple(r[:3]), tuple(r[3:])) for r in rows(values[: 14 * joints], 7)]
    cloth = rows(values[14 * joints :], 3)
    positions, velocities = cloth[:vertices], cloth[vertices:]
    simulator.step(poses[:joints], poses[joints:], positions, velocities)
    flat = [x for row in positions + velocities for x in row]
    return struct.pack(f"<{len(flat)}f", *flat)


def main(answer=answer):
    # The binary streams; anything printed would be taken for an answer.
    source, sink = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr
    kind, payload = receive(source)
    if kind != HELLO:
        return
    hello = json.loads(payload)
    if hello["protocol"] != 1:
        send(sink, FAILED, b"this program speaks protocol 1")
        return
    simulator = Springs(hello)
    send(sink, READY)
    while True:
        kind, payload = receive(source)
        if kind is None:
            return
        try:
            send(sink, STATE, answer(simulator, payload))
        except (ValueError, OverflowError, struct.error) as error:
            send(sink, FAILED, str(error).encode())


if __name__ == "__main__":
    main()
