"""What memories make of the policies that ``asm-gym reproduce transfer`` watches, as records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from asm_gym.detection import AdaptiveThreshold
from asm_gym.episode import Episode
from asm_gym.evaluation.comparison import visible_kinds
from asm_gym.evaluation.metrics import placements
from asm_gym.evaluation.scored import NOMINAL, ScoredEpisode
from asm_gym.monitors import CalibratedMonitor, NeuralASM
from asm_gym.rollouts.scoring import detectability_of, traces_of
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.scripts.reproduce.transfer_watched import Watched
from asm_gym.spec import StreamSpec

Own = Mapping[Watched, Sequence[Episode]]
ADAPTIVE = AdaptiveThreshold(rate=0.05, step=0.3, ceiling=4.0)
LACKING: Mapping[str, tuple[str, ...]] = {
    "nothing": (),
    "the gripper": ("gripper",),
    "the commands": ("action",),
    "gripper and commands": ("gripper", "action"),
    "the wrist": ("wrench",),
    "external torques": ("external_torque", "external_torque_peak"),
    "all torques": ("torque",),
    "the hand": ("hand",),
    "all but joints and commands": ("torque", "hand", "wrench", "gripper"),
    "all but joints": ("torque", "hand", "wrench", "gripper", "action"),
}
"""What a stream may lack: groups of channels, or channels."""


def role(episodes: Sequence[Episode], name: str) -> list[Episode]:
    """Those of a role, and of the nominal roles to learn from only those that succeeded."""
    mine = [e for e in episodes if e.labelled.role == name]
    return [e for e in mine if e.success] if name in ("fit", "calibration") else mine


class Judge(NamedTuple):
    """How one memory's traces become records.

    Attributes:
        window: how soon after its onset a fault must be noticed [s].
        own: episodes of each policy that is watched.
        seed: of the fit.
    """

    window: float
    own: Own
    seed: int

    def records(self, memory: str, monitor: CalibratedMonitor, of: Sequence[Watched]) -> list[Record]:
        """What it makes of all episodes of these policies."""
        found: list[Record] = []
        for watched in of:
            tested = [e for e in self.own[watched] if e.labelled.role in ("nominal", "faulty")]
            found += self._of(memory, watched, traces_of(memory, monitor, tested, monitor.threshold))
        return found

    def adaptive(self, memory: str, monitor: CalibratedMonitor) -> list[Record]:
        """Likewise with a running threshold, one policy after another; faults by what it came to."""
        running, found = ADAPTIVE.start(monitor.threshold), []
        for watched in self.own:
            traces = traces_of(memory, monitor, role(self.own[watched], "nominal"), running.value)
            judged = []
            for trace in traces:
                judged.append(trace.at(running.value))
                running.follow(float(trace.surprise.max()))
            faulty = traces_of(memory, monitor, role(self.own[watched], "faulty"), running.value)
            found += self._of(memory, watched, [*judged, *faulty])
        return found

    def _of(self, memory: str, watched: Watched, traces: Sequence[ScoredEpisode]) -> list[Record]:
        nominal = [t for t in traces if t.kind == NOMINAL]
        seen = visible_kinds(
            detectability_of(role(self.own[watched], "nominal"), role(self.own[watched], "faulty"), self.window)
        )
        where = {"memory": memory, "fit": self.seed, "watched": watched.name, "group": watched.group}
        records: list[Record] = [
            {
                **where,
                "seed": t.seed,
                "solved": t.outcome.success,
                "alarms": len(t.false_alarms),
                "hours": len(t) * t.dt / 3600,
                "threshold": t.threshold,
            }
            for t in nominal
        ]
        steps = round(self.window / nominal[0].dt)
        for t in traces:
            if t.onset is not None and seen[t.kind, t.severity]:
                placed = placements([t], nominal, self.window)
                late = t.detected_after
                records.append(
                    {
                        **where,
                        "seed": t.seed,
                        "kind": t.kind,
                        "severity": t.severity,
                        "found": late is not None and late < steps,
                        "auroc": float(1.0 - placed[0]) if placed.size else None,
                    }
                )
        return records


def fewer_senses(memory: NeuralASM, judge: Judge) -> list[Record]:
    """What is left of the memory of the body without some senses, at the threshold it had with all of them."""
    found: list[Record] = []
    for lacking, gone in LACKING.items():
        channels = tuple(c for c in memory.spec.channels if not {c.name, c.group} & set(gone))
        spec = StreamSpec(channels, memory.spec.dt, memory.spec.source)
        lost = {label for c in memory.spec.channels if c not in channels for label in c.labels}
        kept = {watched: [_cut(e, spec) for e in own if _shows(e, lost)] for watched, own in judge.own.items()}
        found += judge._replace(own=kept).records(f"without {lacking}", memory.for_stream(spec), list(kept))
    return found


def _cut(episode: Episode, spec: StreamSpec) -> Episode:
    """The episode as a stream of ``spec`` has it."""
    return replace(episode, stream=np.ascontiguousarray(episode.stream[:, spec.columns_in(episode.spec)]), spec=spec)


def _shows(episode: Episode, lost: set[str]) -> bool:
    """Whether there may be more to see of its fault than in what is lost."""
    affected = episode.labelled.affected_channels
    return not affected or not affected <= lost
