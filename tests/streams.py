"""Synthetic streams for the tests: several sines seen through many correlated channels, pushed about by an action."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asm_gym.data.episode import Episode
from asm_gym.spec import Channel, StreamSpec


def sine_spec(sensory: int = 12, motor: int = 2) -> StreamSpec:
    """A stream of ``sensory`` joint positions and ``motor`` actions at 20 Hz."""
    channels = [Channel("joint_position", sensory, "rad", group="joint")]
    if motor:
        channels.append(Channel("command", motor, group="action"))
    return StreamSpec(tuple(channels), dt=0.05, source="sines")


def sine_episodes(
    count: int,
    seed: int = 0,
    spec: StreamSpec | None = None,
    steps: tuple[int, int] = (40, 60),
    noise: float = 0.02,
) -> list[Episode]:
    """Episodes whose channels mix four sines of fixed frequency and random phase, and an integrated action.

    Args:
        count: how many.
        seed: of everything random but the mixing, which is the same for every seed.
        spec: of the stream.
        steps: shortest and longest episode.
        noise: standard deviation of white noise on every sense.
    """
    spec = spec or sine_spec()
    sensory, motor = len(spec.sensory), len(spec.motor)
    world = np.random.default_rng(12345)
    mixing = world.normal(size=(4 + motor, sensory))
    frequency = world.uniform(0.05, 0.25, size=4)  # [rad / step]
    rng = np.random.default_rng(seed)
    episodes = []
    for _ in range(count):
        T = int(rng.integers(steps[0], steps[1] + 1))
        phase = rng.uniform(0, 0.5, size=4)
        action = rng.choice([-1.0, 1.0], size=(T, motor))
        moved = np.zeros((T, motor))
        for t in range(T):
            moved[t] = 0.8 * (moved[t - 1] if t else 0.0) + 0.3 * action[t]
        sources = np.concatenate([np.sin(np.arange(T)[:, None] * frequency + phase), moved], axis=1)
        stream = np.zeros((T, spec.size))
        stream[:, spec.sensory] = sources @ mixing + rng.normal(scale=noise, size=(T, sensory))
        stream[:, spec.motor] = action
        episodes.append(Episode.from_stream(stream, spec))
    return episodes


def swing(spec: StreamSpec, seed: int) -> Episode:
    """80 rows of two joints that follow a command back and forth, of the torque that is their sum, and of it."""
    rng = np.random.default_rng(seed)
    command = np.sin(0.1 * np.arange(80) + rng.uniform(0, 6))
    q = np.stack([command, -command], axis=1) + 0.01 * rng.normal(size=(80, 2))
    return Episode.from_stream(np.column_stack([q, q.sum(axis=1), command]), spec, success=True)


def frozen(episode: Episode, column: int, onset: int) -> Episode:
    """The episode with one sense stuck at its value from ``onset`` on."""
    stream = episode.stream.copy()
    stream[onset:, column] = stream[onset, column]
    return replace(episode, stream=stream)


def pendulum_columns(rows: int = 6000, rate: float = 100.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Columns of a pendulum of two joints: friction with a sign, weight, inertia, noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / rate
    w = np.array([[1.1, 2.3], [0.7, 1.9]])
    q = sum(np.sin(np.outer(t, w[:, k]) + k) for k in range(2))
    dq = sum(w[:, k] * np.cos(np.outer(t, w[:, k]) + k) for k in range(2))
    ddq = -sum(w[:, k] ** 2 * np.sin(np.outer(t, w[:, k]) + k) for k in range(2))
    effort = 5 * np.sin(q) + 2 * np.tanh(dq / 0.02) + 0.3 * dq + 0.2 * ddq
    return {
        "time": t,
        "position": q + 1e-4 * rng.normal(size=q.shape),
        "velocity": dq + 1e-3 * rng.normal(size=q.shape),
        "effort": effort + 0.05 * rng.normal(size=q.shape),
    }


EVENTFUL_ARM = StreamSpec(
    (
        Channel("joint_position", 2, "rad", 2e-4, "joint", stops=((-1.0, 1.0), (-2.0, 2.0))),
        Channel("wrist_force", 3, "N", 0.2, "wrench"),
        Channel("wrist_force_peak", 3, "N", 0.4, "wrench"),
        Channel("gripper_velocity", 2, "m/s", 0.002, "gripper"),
    ),
    dt=0.05,
)
"""An arm that knows its stops, forces at its wrist and the speed of its fingers."""

UNEVENTFUL = np.array([0.2, 1.5, 60.0, 0, 0, 10.0, 0, 0, 0, 0])
"""A row of it without an event; where a peak is sensed, the mean tells no knock."""


def arm_table(seed: int, rows: int = 80) -> dict[str, np.ndarray]:
    """A log at 50 Hz: two joints that follow a command, and the torque that takes."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / 50.0
    command = np.sin(np.outer(t, [2.0, 3.0]) + rng.uniform(0, 6, 2))
    joints = command + 0.01 * rng.normal(size=command.shape)
    return {
        "time": t,
        **{f"q_{k}": joints[:, k] for k in range(2)},
        **{f"cmd_{k}": command[:, k] for k in range(2)},
        "torque": joints.sum(axis=1) + 0.01 * rng.normal(size=rows),
    }
