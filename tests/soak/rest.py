"""An arm at rest, watched for as long as asked: how many alarms it raises, and whether a push is still seen after.

    python -m tests.soak.rest --minutes 60

A synthetic arm of four joints at 50 Hz: encoders that repeat their digits, torques with noise, weight and friction. Two
hundred moves of ten seconds each, that begin and end at rest, are learned from and calibrated on, as ``asm-gym fit``
does of logs. Then the arm rests where it never rested before, and at the end somebody leans on it.
"""

from __future__ import annotations

import argparse

import numpy as np

from asm_gym.detection import alarms_in
from asm_gym.episode import Episode
from asm_gym.monitors import CalibratedMonitor, make_monitor

RATE, JOINTS, MOVE_S = 50.0, 4, 10.0
COUNT = 2 * np.pi / 2**16  # of an encoder [rad]
TORQUE_NOISE, PUSH, PUSHED_S = 0.05, 1.0, 2.0  # [N m], [N m], [s]


def rows(q: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Columns of an arm at angles and speeds (T, J); at rest friction holds what it held last."""
    torque = 3 * np.cos(q) + 0.5 * np.tanh(v / 0.05) + 0.2 * v
    read = np.rint((q + 1e-6 * rng.normal(size=q.shape)) / COUNT) * COUNT
    speed = np.rint(v / 1e-3) * 1e-3
    return {"position": read, "velocity": speed, "effort": torque + TORQUE_NOISE * rng.normal(size=q.shape)}


def move(seed: int) -> Episode:
    """From one place to another, at rest before and after."""
    rng, T = np.random.default_rng(seed), int(MOVE_S * RATE)
    begin, end = rng.uniform(-1.2, 1.2, size=(2, JOINTS))
    s = np.clip((np.arange(T) / T - 0.2) / 0.6, 0, 1)[:, None]
    q = begin + (end - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5)
    return Episode.from_table(rows(q, np.gradient(q, 1 / RATE, axis=0), rng), rate=RATE, success=True)


def at_rest(seconds: float, seed: int, push: bool = True) -> Episode:
    """In one place; at the end a joint is leaned on."""
    rng, T = np.random.default_rng(seed), int(seconds * RATE)
    q = np.tile(rng.uniform(-1.0, 1.0, JOINTS), (T, 1))
    columns = rows(q, np.zeros_like(q), rng)
    if push:
        columns["effort"][-int(PUSHED_S * RATE) :, 1] += PUSH
    return Episode.from_table(columns, rate=RATE)


def watched(monitor: CalibratedMonitor, seconds: float, seed: int) -> tuple[int, bool]:
    """How many alarms there are before the push, and whether there is one after."""
    episode = at_rest(seconds, seed)
    value = monitor.score(Episode.from_stream(episode.stream, monitor.spec)).value
    onset = len(value) - int(PUSHED_S * RATE)
    before = alarms_in(value[:onset], monitor.threshold, monitor.spec.dt)
    return before, bool((value[onset:] > monitor.threshold).any())


def learned(moves: int, rate: float) -> CalibratedMonitor:
    """The default monitor, as logs have it."""
    episodes = [move(seed) for seed in range(moves)]
    monitor: CalibratedMonitor = make_monitor("neural_asm", episodes[0].spec, values=True)
    return monitor.fit(episodes[::2]).calibrate(episodes[1::2], rate)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--moves", type=int, default=200)
    args = parser.parse_args()
    monitor = learned(args.moves, 0.01)
    alarms, pushed = watched(monitor, 60 * args.minutes, 1_000_000)
    print(
        f"{alarms} alarms in {args.minutes:g} minutes at rest; the push after them is {'' if pushed else 'not '}found"
    )


if __name__ == "__main__":
    main()
