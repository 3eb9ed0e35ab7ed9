"""A recurrent clone: a GRU that learns to act as an expert did, from what was seen so far in an episode.

    L = mean_t ‖W h_t + b - a_t‖²,   h_t = GRU(x_t + σ ξ_t, h_{t-1})        ξ white

Sources: Pomerleau 1991 for cloning; Mandlekar et al. 2021 (CoRL, robomimic) for recurrent clones of manipulation.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn.utils.rnn import pad_sequence

from asm_gym.episode import Episode
from asm_gym.policies.network import Cell, NetworkPolicy
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.training.cloning import steps_of
from asm_gym.rollouts.training.run import ObservationScale

RECURRENT = "gru"
"""Its name among the algorithms."""
UNITS, BATCH = 128, 16
NOISE = 0.1
"""σ, of standardised observations: without it a clone knows no way back to the expert's course."""
CLIP = 1.0
"""Norm that a gradient is cut off at."""


def clone_recurrent(episodes: Sequence[Episode], updates: int, seed: int, progress: Progress) -> NetworkPolicy:
    """The clone of an expert's whole episodes.

    Args:
        updates: batches of episodes that it learns from.
        seed: of the weights, the batches and the noise.
    """
    standard = ObservationScale.of(steps_of(episodes)[0])
    seen = [torch.as_tensor((e.observations[:-1] - standard.mean) / standard.scale).float() for e in episodes]
    acted = [torch.as_tensor(e.actions) for e in episodes]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        cell, readout = nn.GRU(seen[0].shape[1], UNITS, batch_first=True), nn.Linear(UNITS, acted[0].shape[1])
    draw = torch.Generator().manual_seed(seed)
    weights = [*cell.parameters(), *readout.parameters()]
    optimiser = torch.optim.Adam(weights, lr=3e-3)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    for n in range(updates):
        drawn = torch.randint(len(episodes), (BATCH,), generator=draw).tolist()
        x, a = (pad_sequence([own[i] for i in drawn], batch_first=True) for own in (seen, acted))
        real = pad_sequence([torch.ones(len(acted[i]), 1) for i in drawn], batch_first=True)  # (B, T, 1)
        means = readout(cell(x + NOISE * torch.randn(x.shape, generator=draw))[0])
        loss = (real * (means - a) ** 2).sum() / real.sum()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(weights, CLIP)
        optimiser.step()
        decay.step()
        progress(n + 1, updates)
    arrays = [p.detach().numpy() for p in weights]
    return NetworkPolicy(
        [(arrays[4], arrays[5])], "tanh", "clip", mean=standard.mean, scale=standard.scale, cell=Cell(*arrays[:4])
    )
