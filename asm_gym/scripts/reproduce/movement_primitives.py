"""Skill memories of robotics as rivals: probabilistic movement primitives, and dynamic movement primitives.

    ProMP    y_t = Φ_t w + noise,  w ~ N(m_k, S_k) of skill k;  a cue gives p(k) and p(w | k), by Bayes' rule
    DMP      τ ÿ = α (β (g - y) - ẏ) + f_k(s),  τ ṡ = -a s      f_k: of the mean demonstration of skill k

Both are told which demonstration is of which skill. The DMP of the skill whose mean is nearest to the cue goes on from
where the cue ends.

Sources: Paraschos et al. 2013 (NeurIPS); Ijspeert et al. 2013 (Neural Computation 25(2)).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BASES = 20  # radial functions of time, for each coordinate
RIDGE = 1e-6  # of the weights of a demonstration
SHRINKAGE = 0.1  # of the covariance of weights towards its diagonal
STIFFNESS = 25.0  # α of a DMP; β = α/4 damps it critically
PHASE_DECAY = 3.0  # a, by which s falls to exp(-a) over the movement


def radial_bases(steps: int) -> Floats:
    """Return the normalised values Φ (T, BASES) of radial functions at the rows of a movement."""
    phase = np.linspace(0.0, 1.0, steps)
    centres = np.linspace(0.0, 1.0, BASES)
    values = np.exp(-0.5 * ((phase[:, None] - centres) * (BASES - 1)) ** 2)
    return values / values.sum(axis=1, keepdims=True)


class WeightPrior(NamedTuple):
    """How the weights of a skill are distributed."""

    mean: Floats  # (2 BASES,) m_k
    covariance: Floats  # (2 BASES, 2 BASES) S_k


class ProMP:
    """Probabilistic movement primitives of several skills.

    Args:
        paths: (N, T, 2) demonstrations.
        skills: (N,) name of the skill of each.
        noise: standard deviation of a sensed position.
    """

    def __init__(self, paths: Floats, skills: NDArray[np.str_], noise: float) -> None:
        self.noise = noise
        bases = radial_bases(paths.shape[1])
        self.basis = np.kron(np.eye(2), bases)  # (2 T, 2 BASES)
        flat = paths.swapaxes(1, 2).reshape(len(paths), -1)  # (N, 2 T)
        normal = self.basis.T @ self.basis + RIDGE * np.eye(self.basis.shape[1])
        weights = np.linalg.solve(normal, self.basis.T @ flat.T).T
        self.priors = [self._prior(weights[skills == name]) for name in np.unique(skills)]

    @staticmethod
    def _prior(weights: Floats) -> WeightPrior:
        covariance = np.cov(weights, rowvar=False)
        diagonal = np.diag(np.diag(covariance) + 1e-6)
        return WeightPrior(
            mean=weights.mean(axis=0),
            covariance=(1 - SHRINKAGE) * covariance + SHRINKAGE * diagonal,
        )

    def recall(self, cue: Floats) -> Floats:
        """Return the most likely path (T, 2) after its first rows (C, 2)."""
        steps = len(self.basis) // 2
        observed = np.concatenate([np.arange(len(cue)), steps + np.arange(len(cue))])
        seen = self.basis[observed]
        values = cue.T.ravel()
        recalled = []
        likelihoods = []
        for prior in self.priors:
            spread = seen @ prior.covariance @ seen.T + self.noise**2 * np.eye(len(values))
            surprise = values - seen @ prior.mean
            explained = np.linalg.solve(spread, surprise)
            _, log_determinant = np.linalg.slogdet(spread)
            likelihoods.append(-0.5 * (surprise @ explained + log_determinant))
            recalled.append(prior.mean + prior.covariance @ seen.T @ explained)
        best = recalled[int(np.argmax(likelihoods))]
        return (self.basis @ best).reshape(2, steps).T


class DMP:
    """Dynamic movement primitives of several skills; arguments as of ``ProMP``."""

    def __init__(self, paths: Floats, skills: NDArray[np.str_], dt: float) -> None:
        self.dt = dt
        self.means = [paths[skills == name].mean(axis=0) for name in np.unique(skills)]
        steps = paths.shape[1]
        self.duration = dt * (steps - 1)
        self.phase = np.exp(-PHASE_DECAY * np.linspace(0.0, 1.0, steps))  # s (T,)
        self.bases = radial_bases(steps)
        self.forcing = [self._forcing(path) for path in self.means]

    def _forcing(self, path: Floats) -> Floats:
        """Return the weights (BASES, 2) of the forcing term that makes the system follow a path (T, 2)."""
        velocity = np.gradient(path, self.dt, axis=0)
        acceleration = np.gradient(velocity, self.dt, axis=0)
        tau = self.duration
        pull = STIFFNESS * (STIFFNESS / 4 * (path[-1] - path) - tau * velocity)
        force = tau**2 * acceleration - pull
        features = self.bases * self.phase[:, None]
        normal = features.T @ features + RIDGE * np.eye(BASES)
        return np.linalg.solve(normal, features.T @ force)

    def recall(self, cue: Floats) -> Floats:
        """Return the path (T, 2) that goes on from its first rows (C, 2)."""
        rows = len(cue)
        distances = [np.linalg.norm(mean[:rows] - cue, axis=1).mean() for mean in self.means]
        skill = int(np.argmin(distances))
        goal = self.means[skill][-1]
        force = (self.bases * self.phase[:, None]) @ self.forcing[skill]
        tau = self.duration
        position = cue[-1].copy()
        velocity = (self.means[skill][rows] - self.means[skill][rows - 1]) / self.dt
        path = [*cue]
        for t in range(rows, len(self.phase)):
            pull = STIFFNESS * (STIFFNESS / 4 * (goal - position) - tau * velocity)
            acceleration = (pull + force[t]) / tau**2
            velocity = velocity + self.dt * acceleration
            position = position + self.dt * velocity
            path.append(position)
        return np.array(path)


def recalled_paths(memory: ProMP | DMP, paths: Floats, cue: int) -> Floats:
    """Return the recalled paths (N, T, 2) of paths (N, T, 2) of which the first ``cue`` rows are read."""
    return np.array([memory.recall(path[:cue]) for path in paths])
