"""Acting from memory: the command that comes next, and the rows that follow a cue."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.episode import Episode
from asm_gym.memory.motor import learn_motor, lessons
from asm_gym.memory.recall import continued
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.monitors.training_data import check_nominal


def learn_to_act(memory: NeuralASM, episodes: Sequence[Episode], units: int = 512) -> NeuralASM:
    """Learn what to command in which situation, so that ``NeuralASMPolicy`` can act by it, and return the memory.

    Only ``expected_action`` depends on it: neither the other weights nor the surprise do.

    Args:
        memory: fitted; it is changed.
        episodes: whose ``actions`` are the commands; where they are empty, the stream holds them.
        units: hidden units of the motor association.
    """
    memory._require_fitted()
    check_nominal(episodes, memory.spec, memory.model.shortest)
    model = memory.model
    with threadpool_limits(1):
        motor = learn_motor(*lessons(model.senses_, episodes), units, np.random.default_rng(memory.seed))
    model.restore({**model.learned_, **motor.named()}, model.skills_)
    return memory


def recall(memory: NeuralASM, cue: NDArray[np.floating[Any]], steps: int) -> NDArray[np.float64]:
    """Return the rows (steps, D) that follow a cue, from memory alone, in the units of the stream.

    Actions are the memory's own motor predictions. Fit with ``free_running_probability`` above 0 to make it learn to
    run on.

    Args:
        memory: fitted.
        cue: (T, D) the first rows of an episode, at least a tenth of a second and 2 rows.
        steps: number of rows to recall.

    Raises:
        ValueError: the cue is too short, not finite, or of another width; fewer than one step, or more than a million.
    """
    memory._require_fitted()
    return continued(memory.model.network, memory.model.senses_, cue, steps)
