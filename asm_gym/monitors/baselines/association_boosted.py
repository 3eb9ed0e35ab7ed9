"""The memory's question, answered by trees: what ridge regression leaves of each change, by gradient boosting.

    ε_t = (Δ_t - D a_t - s F(a_t))/(s r)     D, s as in ``association_linear``;  F: boosted trees for each change
                                             r: the spread of what they leave in episodes that they have not learned

The trees of group g do not see what it does now, as in the memory's association. They take the place of its hidden
units. Source: Friedman 2001 (Annals of Statistics 29(5)); Ke et al. 2017 (NeurIPS) for histograms, by scikit-learn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingRegressor

from asm_gym.compilation import compiled
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.association import synapses
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.association_linear import FAINTEST, LinearAssociation
from asm_gym.monitors.baselines.base import Lagged, associated, no_context
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

FRESH = 5
"""One in so many episodes is not learned by the trees, but shows how wrong they are."""


FEATURE, THRESHOLD, LEFT, RIGHT, VALUE = range(5)
"""Columns of a node: which input, where it parts, who comes next (-1 in a leaf), and what a leaf says."""

LARGEST = 1e30
"""Bound of a threshold: some are infinite, which a checkpoint does not hold."""


class BoostedAssociation(LinearAssociation):
    """Ridge regression of each group's changes, and boosted trees for what it leaves; it has no context.

    Args:
        spec: the stream it is to expect.
        trees: for a change, at most; fewer where a tenth of the rows gains no more.
        leaves: of a tree, at most.
        learning_rate: in (0, 1], the share that each tree counts.
    """

    kind = "association_boosted"

    @typed
    def __init__(self, spec: StreamSpec, trees: int = 100, leaves: int = 15, learning_rate: float = 0.1) -> None:
        super().__init__(spec)
        self.trees = check_number("trees", trees, low=1, whole=True)
        self.leaves = check_number("leaves", leaves, low=2, whole=True)
        self.learning_rate = check_number("learning_rate", learning_rate, above=0.0, high=1.0)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        super().fit(episodes, rng, progress)
        linear, senses, kept = self.learned_, self.senses_, len(episodes) // FRESH
        inputs = [senses.read_episode(e.stream).inputs[self.lag :] for e in episodes]
        a, tried = np.concatenate(inputs[kept:]), np.concatenate(inputs[:kept] or inputs)

        def left(rows: NDArray[np.float32]) -> NDArray[np.float64]:
            remains: NDArray[np.float64] = (rows[:, senses.changes] - rows @ linear["D"].T) / linear["remainder"]
            return remains

        forest, target = _Forest(), left(a)
        for i, seen in enumerate(synapses(senses.groups, senses.changes, senses.inputs, 1).D > 0):
            progress(i, target.shape[1])
            boosted = HistGradientBoostingRegressor(
                learning_rate=self.learning_rate,
                max_iter=self.trees,
                max_leaf_nodes=self.leaves,
                early_stopping=True,
                random_state=int(rng.integers(2**31)),
            )
            forest.grow(boosted.fit(a[:, seen], target[:, i]), np.flatnonzero(seen))
        trees = forest.arrays
        remains = left(tried) - _said(tried.astype(np.float64), **trees)
        spread = np.maximum(np.sqrt(np.mean(remains**2, axis=0)), FAINTEST)
        return self.restore({**linear, **trees, "deviation": spread})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        if "nodes" in learned:
            nodes, own = learned["nodes"], learned["nodes"][:, LEFT] >= 0
            places = (nodes[own, LEFT], nodes[own, RIGHT], learned["first"])
            # A node leads to later ones alone, or what the trees say would take for ever.
            later = (nodes[own][:, [LEFT, RIGHT]] > np.flatnonzero(own)[:, None]).all()
            fit = all(((p >= 0) & (p < len(nodes))).all() for p in places)
            fit = fit and bool(((nodes[:, FEATURE] >= 0) & (nodes[:, FEATURE] < learned["D"].shape[1])).all())
            if not (later and fit and ((learned["output"] >= 0) & (learned["output"] < len(learned["base"]))).all()):
                raise ValueError(f"the trees of this {self.kind} do not fit together")
        return super().restore(learned, skills)

    def predict(self, state: Lagged, rows: NDArray[np.float64]) -> tuple[Lagged, ModelOutput]:
        state, r, known = associated(self.senses_, state, rows)
        found = self.learned_
        left = (r.changes - r.inputs @ found["D"].T) / found["remainder"]
        said = _said(r.inputs.astype(np.float64), *(found[name] for name in ("nodes", "first", "output", "base")))
        return state, ModelOutput(known * (left - said) / found["deviation"], no_context(rows))


class _Forest:
    """The trees of all changes, one after another."""

    def __init__(self) -> None:
        self._nodes: list[NDArray[np.float64]] = []
        self._first: list[int] = []
        self._output: list[int] = []
        self._base: list[float] = []
        self._size = 0

    def grow(self, boosted: Any, inputs: NDArray[np.intp]) -> None:
        """Adds those of the next change, which saw these ``inputs`` alone."""
        for (tree,) in boosted._predictors:  # scikit-learn names no public way to its trees, and a pickle is none
            found = tree.nodes
            leaf = found["is_leaf"].astype(bool)
            nodes = np.zeros((len(found), 5))
            nodes[:, FEATURE] = np.where(leaf, 0, inputs[np.where(leaf, 0, found["feature_idx"])])
            nodes[:, THRESHOLD] = np.clip(found["num_threshold"], -LARGEST, LARGEST)
            for column, name in ((LEFT, "left"), (RIGHT, "right")):
                nodes[:, column] = np.where(leaf, -1.0, found[name].astype(np.float64) + self._size)
            nodes[:, VALUE] = found["value"]
            self._nodes.append(nodes)
            self._first.append(self._size)
            self._output.append(len(self._base))
            self._size += len(nodes)
        self._base.append(float(np.ravel(boosted._baseline_prediction)[0]))

    @property
    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """The nodes (N, 5), the first node of each tree (T,), its output (T,), and what each begins with (X,)."""
        return {
            "nodes": np.concatenate([*self._nodes, np.zeros((0, 5))]),
            "first": np.array(self._first, np.float64),
            "output": np.array(self._output, np.float64),
            "base": np.array(self._base),
        }


@compiled
def _said(a: Any, nodes: Any, first: Any, output: Any, base: Any) -> Any:
    """(B, X) the sums of the trees for inputs (B, I); the others as in ``_Forest.arrays``."""
    out = np.empty((a.shape[0], base.shape[0]))
    out[:] = base
    for t in range(first.shape[0]):  # all rows go through one tree while the processor has it at hand
        root, place = int(first[t]), int(output[t])
        for b in range(a.shape[0]):
            n = root
            while nodes[n, 2] >= 0:
                n = int(nodes[n, 2]) if a[b, int(nodes[n, 0])] <= nodes[n, 1] else int(nodes[n, 3])
            out[b, place] += nodes[n, 4]
    return out
