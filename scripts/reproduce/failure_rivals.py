"""Rivals of skill surprise that read what a policy commands, after those that predict failures of learned policies.

reversals       share of the last second in which the commanded direction turned by more than a right angle
inconsistency   Σ_t ‖a_t - a_{t-1}‖, after STAC: there the distance between action chunks planned one after another,
                added up over the episode. A policy that plans one action has no overlap; its change is what is left.
two_signals     min(r/θ_r, c/θ_c) > 1, after FIPER: random network distillation r and the entropy c of actions, each
                over a window, each with a conformal threshold θ, and an alarm where both are over it. There r reads
                the policy's embedding and c many sampled chunks; here r reads the row, and c is the Gaussian entropy
                of the last second's commands, as exp(entropy/A). The shipped agents have no noise to sample from.

Sources: Agia et al. 2025 (CoRL, PMLR 270), “Unpacking failure modes of generative policies”, for STAC; Römer et al.
2025 (NeurIPS), “Failure prediction at runtime for generative robot policies”, for FIPER.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import conformal_threshold
from asm_gym.episode import Episode
from asm_gym.monitors import make_monitor

Floats = NDArray[np.float64]

WINDOW = 1.0
"""What is asked over a window, over so long [s]."""
FAINTEST = 1e-6
"""Variance that every command has at least."""


class Scored(NamedTuple):
    """What episodes were scored by one rival, and what is an alarm."""

    values: list[Floats]  # (T,) each
    threshold: float


def scored(
    name: str,
    seed: int,
    fit: Sequence[Episode],
    calibration: Sequence[Episode],
    tested: Sequence[Episode],
    rate: float,
) -> Scored:
    """By a monitor of that name, or by one of ``RIVALS``, with a conformal threshold for the false-alarm ``rate``."""
    if name == "two_signals":
        both = [
            scored("rnd", seed, fit, calibration, tested, rate),
            _conformal(entropy, calibration, tested, rate),
        ]
        ratios = [[v / one.threshold for v in one.values] for one in both]
        return Scored([np.minimum(r, c) for r, c in zip(*ratios, strict=True)], 1.0)
    if name in RIVALS:
        return _conformal(RIVALS[name], calibration, tested, rate)
    monitor = make_monitor(name, fit[0].spec, seed=seed).fit(fit).calibrate(calibration, rate)
    return Scored([s.value for s in monitor.score_episodes(tested)], monitor.threshold)


def _conformal(
    score: Callable[[Episode], Floats], calibration: Sequence[Episode], tested: Sequence[Episode], rate: float
) -> Scored:
    maxima = np.array([score(e).max() for e in calibration])
    return Scored([score(e) for e in tested], conformal_threshold(maxima, rate))


def reversals(episode: Episode) -> Floats:
    """(T,) of the first three commands, the hand's translation."""
    a = _commands(episode)[:, :3]
    turned = np.append(0.0, np.einsum("ti,ti->t", a[1:], a[:-1]) < 0)
    return np.array([turned[part].mean() for part in _windows(episode)])


def inconsistency(episode: Episode) -> Floats:
    """(T,)"""
    a = _commands(episode)
    found: Floats = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(a, axis=0), axis=1)))
    return found


def entropy(episode: Episode) -> Floats:
    """(T,) exp(entropy/A) of a Gaussian: 4.13 standard deviations, their geometric mean."""
    a = _commands(episode)
    least = FAINTEST * np.eye(a.shape[1])
    covariances = np.array([np.cov(a[part].T, bias=True).reshape(least.shape) + least for part in _windows(episode)])
    log_spread = 0.5 * np.linalg.slogdet(covariances)[1] / a.shape[1]
    found: Floats = np.sqrt(2 * np.pi * np.e) * np.exp(log_spread)
    return found


RIVALS: dict[str, Callable[[Episode], Floats]] = {"reversals": reversals, "inconsistency": inconsistency}
NAMES = (*RIVALS, "two_signals")


def _commands(episode: Episode) -> Floats:
    return episode.stream[:, episode.spec.motor].astype(np.float64)


def _windows(episode: Episode) -> list[slice]:
    """Of each row: itself and those of the last ``WINDOW``."""
    rows = max(1, round(WINDOW / episode.spec.dt))
    return [slice(max(0, t + 1 - rows), t + 1) for t in range(len(episode))]
