"""Checkpoints of a training run: all that is needed to go on, in arrays and JSON."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from asm_gym.files import named

ANCHOR = "anchor.pth"
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass(frozen=True)
class TrainingState:
    """How far a run has come.

    Args:
        steps: control steps that were learned from.
        best: share of successes of the best agent so far that has learned from its own steps; -1 before there is one.
        curve: (steps, share of successes) of each evaluation.
    """

    steps: int
    best: float
    curve: tuple[tuple[int, float], ...]


def save(
    out: Path, learner: BaseAlgorithm, reached: TrainingState, anchor: torch.optim.Optimizer | None = None
) -> Path:
    """Writes a checkpoint, which appears when it is complete, and removes older ones.

    Args:
        anchor: what keeps the learner near its expert, where something does.
    """
    steps, counted = learner.num_timesteps, cast(Any, learner)
    folder = out / f"checkpoint_{steps}"
    unfinished = out / ".checkpoint"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    whole = BytesIO()  # torch does not say which disk is full
    learner.save(whole)
    with named(unfinished / "learner.zip"):
        (unfinished / "learner.zip").write_bytes(whole.getvalue())
    if isinstance(learner, OffPolicyAlgorithm):
        buffer: Any = learner.replay_buffer
        size = buffer.size()
        arrays = {name: getattr(buffer, name)[:size] for name in _BUFFER}
        with named(unfinished / "buffer.npz"):
            np.savez(unfinished / "buffer.npz", pos=buffer.pos, full=buffer.full, **arrays)
    if anchor is not None:
        kept = BytesIO()
        torch.save(anchor.state_dict(), kept)
        with named(unfinished / ANCHOR):
            (unfinished / ANCHOR).write_bytes(kept.getvalue())
    state = asdict(reached) | {"steps": steps, "updates": counted._n_updates}
    (unfinished / "state.json").write_text(json.dumps(state), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.rename(folder)
    for other in out.glob("checkpoint_*"):
        if other != folder:
            shutil.rmtree(other)
    return folder


def newest(out: Path) -> Path | None:
    """The checkpoint to go on from, where there is one."""
    found = sorted(out.glob("checkpoint_*"), key=lambda f: int(f.name.rsplit("_", 1)[-1]))
    return found[-1] if found else None


def resume(folder: Path, learner: BaseAlgorithm, anchor: torch.optim.Optimizer | None = None) -> TrainingState:
    """Puts a learner of the same settings where the checkpoint was made; only tensors and arrays are read.

    Raises:
        ValueError: the checkpoint is damaged, or of other settings.
    """
    counted = cast(Any, learner)
    try:
        state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
        _, parameters, variables = load_from_zip_file(folder / "learner.zip", load_data=False, device="cpu")
        learner.set_parameters(parameters, device="cpu")
        for name, value in (variables or {}).items():  # SAC's temperature
            getattr(learner, name).data = value.data
        if isinstance(learner, OffPolicyAlgorithm):
            buffer: Any = learner.replay_buffer
            with np.load(folder / "buffer.npz", allow_pickle=False) as arrays:
                for name in _BUFFER:
                    getattr(buffer, name)[: len(arrays[name])] = arrays[name]
                buffer.pos, buffer.full = int(arrays["pos"]), bool(arrays["full"])
        if anchor is not None:
            anchor.load_state_dict(torch.load(folder / ANCHOR, map_location="cpu", weights_only=True))
        learner.num_timesteps, counted._n_updates = state["steps"], state["updates"]
        curve = tuple((int(s), float(x)) for s, x in state["curve"])
        return TrainingState(state["steps"], state["best"], curve)
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder} is no checkpoint to go on from: {error}") from error
