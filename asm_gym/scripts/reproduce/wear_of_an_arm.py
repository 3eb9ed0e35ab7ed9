"""Wear of a synthetic arm: how soon a drifting encoder and growing friction are told, and how often healthy hours are.

Episodes are drawn with replacement from those recorded. An encoder drifts linearly to 0.05 rad in ten minutes, friction
grows by a fifth in an hour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym import collect
from asm_gym.data.episode import Episode
from asm_gym.detection.drift import DriftSenses, Wear, WearCounter, WearScale, wear_scale
from asm_gym.evaluation.tables import Table
from asm_gym.memory.completion import Completion
from asm_gym.monitors.torque.arm_features import torque_names, torques_with_speeds
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings
from asm_gym.synthetic_arm import CONTROL_PERIOD_S, JOINTS, SyntheticArm

ENV = "asm_gym/SyntheticArm-v0"
ENCODER_DRIFT = 0.05 / 600.0  # [rad/s]
FRICTION_GROWTH = 0.2 / 3600.0  # of healthy friction [1/s]
SPEC = SyntheticArm.stream_spec

Stream = NDArray[np.float32]


@dataclass(frozen=True)
class Config(kit.Config):
    """Wear of a synthetic arm."""

    seeds: int = option(3, quick=1, least=1)
    """Number of repetitions, each with other orders of the episodes."""
    episodes: int = option(100, quick=40, least=20)
    """Episodes to calibrate on; half as many are learned from, and as many are drawn from."""
    levels: int = option(11, quick=3, least=2)
    """Levels of friction that are recorded, a tenth as many episodes each."""
    hours: float = option(4.0, quick=0.2)
    """Healthy hours of each repetition."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Episodes of the arm, and what wear is judged by."""

    healthy: list[Stream]
    worn: dict[float, list[Stream]]  # by friction
    senses: DriftSenses
    scale: WearScale


def run(config: Config) -> Findings:
    """Tell wear in healthy hours, with each drifting encoder, and with growing friction."""
    recorded = record(config)
    records = []
    for seed in config.repetitions:
        rng = np.random.default_rng(seed)
        healthy = drawn(rng, recorded.healthy, config.hours * 3600.0)
        told = first_told(recorded, healthy)
        records.append({"seed": seed, "drift": "none", "joint": -1, **told})
        for joint in range(JOINTS):
            streams = drawn(rng, recorded.healthy, 600.0)
            told = first_told(recorded, drifting(streams, joint))
            records.append({"seed": seed, "drift": "encoder", "joint": joint, **told})
        told = first_told(recorded, rubbing(rng, recorded.worn))
        records.append({"seed": seed, "drift": "friction", "joint": -1, **told})
    return Findings(records, [table_of(records, recorded.scale)])


def record(config: Config) -> Recorded:
    """Record the episodes, learn to complete senses, and calibrate."""
    half = config.episodes // 2
    count = half + 2 * config.episodes
    episodes = collect(ENV, "sway", count, config.seed, config.workers)
    streams = [episode.stream for episode in episodes]
    completion = Completion.fit(StreamScaler.fit(SPEC, streams[:half]), streams[:half])
    assert completion is not None
    withheld = np.zeros(SPEC.size, bool)
    withheld[torque_names(SPEC)] = True
    senses = DriftSenses.of(completion, torques_with_speeds(SPEC), withheld)
    scale = wear_scale(senses, streams[half : half + config.episodes], SPEC.dt)
    assert scale is not None
    worn = {}
    for level, friction in enumerate(np.linspace(1.0, 1.2, config.levels)):
        few = max(config.episodes // 10, 5)
        own = worn_episodes(float(friction), few, config, stage=1 + level)
        worn[float(friction)] = [episode.stream for episode in own]
    return Recorded(streams[half + config.episodes :], worn, senses, scale)


def worn_episodes(friction: float, count: int, config: Config, stage: int) -> list[Episode]:
    """Record episodes of an arm with so many times the friction."""
    return collect(ENV, "sway", count, config.seed, config.workers, stage=stage, friction=friction)


def drawn(rng: np.random.Generator, streams: Sequence[Stream], seconds: float) -> Iterator[Stream]:
    """Yield streams in a random order, with replacement, for so long."""
    time = 0.0
    while time < seconds:
        stream = streams[int(rng.integers(len(streams)))]
        time += len(stream) * CONTROL_PERIOD_S
        yield stream


def drifting(streams: Iterator[Stream], joint: int) -> Iterator[Stream]:
    """Yield streams in which a joint's encoder drifts."""
    time = 0.0
    for stream in streams:
        worn = stream.copy()
        seconds = time + CONTROL_PERIOD_S * np.arange(len(stream))
        worn[:, joint] += (ENCODER_DRIFT * seconds).astype(np.float32)
        time += len(stream) * CONTROL_PERIOD_S
        yield worn


def rubbing(rng: np.random.Generator, worn: dict[float, list[Stream]]) -> Iterator[Stream]:
    """Yield the streams of an hour in which friction grows."""
    levels = np.array(list(worn))
    time = 0.0
    while time < 3600.0:
        friction = 1.0 + FRICTION_GROWTH * time
        nearest = float(levels[np.abs(levels - friction).argmin()])
        stream = worn[nearest][int(rng.integers(len(worn[nearest])))]
        time += len(stream) * CONTROL_PERIOD_S
        yield stream


def first_told(recorded: Recorded, streams: Iterator[Stream]) -> dict[str, Any]:
    """Return when wear was told first [s], of which channel, and how often in all; told wear is acknowledged."""
    counter = WearCounter(recorded.senses, recorded.scale)
    time = 0.0
    first = np.nan
    strongest = Wear(channel="", kind="", since_s=0.0)
    count = 0
    for stream in streams:
        time += len(stream) * CONTROL_PERIOD_S
        worn = counter.follow(stream, CONTROL_PERIOD_S)
        if worn:
            if not count:
                first = time
                strongest = worn[0]
            count += 1
            counter.acknowledge()
    return {
        "seconds": time,
        "told_after": first,
        "channel": strongest.channel,
        "kind": strongest.kind,
        "count": count,
    }


def table_of(records: Sequence[kit.Record], scale: WearScale) -> Table:
    """Return a row for each drift."""
    rows = []
    for drift, joint in dict.fromkeys((r["drift"], r["joint"]) for r in records):
        own = [r for r in records if (r["drift"], r["joint"]) == (drift, joint)]
        times = np.array([r["told_after"] for r in own])
        told = times[np.isfinite(times)]
        name = {"none": "healthy", "encoder": f"encoder {joint}", "friction": "friction"}[drift]
        row = {
            "drift": name,
            "hours": f"{sum(r['seconds'] for r in own) / 3600.0:.2f}",
            "told in": f"{len(told)} of {len(own)}",
            "told after [s]": f"{np.median(told):.0f}" if len(told) else "",
            "first channels": ", ".join(sorted({r["channel"] for r in own if r["channel"]})),
        }
        rows.append(row)
    return kit.table_of(
        f"Wear of the synthetic arm, from {len(scale.spread)} numbers; "
        f"blocks of {scale.block_s:g} s; 0.1 false ones an hour are promised. "
        "An encoder drifts to 0.05 rad in ten minutes, friction grows by 20 % in an hour.",
        rows,
    )
