"""What a memory learns of skills: their names, the command that comes next, and to recall them from a cue."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.data.episode import Episode
from asm_gym.memory.association import hidden_units
from asm_gym.memory.motor import learn_motor, situation
from asm_gym.memory.readout import learn_readout
from asm_gym.memory.recall import continued
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.monitors.stream_model import model_outputs
from asm_gym.monitors.training_data import check_nominal
from asm_gym.scaling import StreamScaler


def name_skills(memory: NeuralASM, episodes: Sequence[Episode]) -> NeuralASM:
    """Learn to tell which skill is running, from episodes that name it, and return the memory.

    ``info["skill"]`` is the skill of an episode. Only ``Surprise.skill`` depends on it.

    Raises:
        ValueError: an episode names none, or all name the same.
    """
    memory._require_fitted()
    check_nominal(episodes, memory.spec, memory.model.shortest)
    names = [str(episode.info.get("skill", "")) for episode in episodes]
    if not all(names):
        raise ValueError(f"episode {names.index('')} does not say its skill: set info['skill']")
    rows = [len(episode) for episode in episodes]
    known, skills = np.unique(np.repeat(names, rows), return_inverse=True)
    if len(known) < 2:
        raise ValueError(f"naming skills needs at least two of them, got {', '.join(known)}")

    model = memory.model
    readings = [model.senses_.read_episode(episode.stream) for episode in episodes]
    inputs = np.concatenate([reading.inputs for reading in readings])
    rng = np.random.default_rng(memory.seed)
    with threadpool_limits(1):
        outputs = model_outputs(model, episodes)
        contexts = np.concatenate([output.contexts for output in outputs])

        def units_of(some: NDArray[np.intp]) -> NDArray[np.float32]:
            units = hidden_units(inputs[some], model.network.association.V)
            return np.hstack([units, contexts[some]])

        W_K, b_K = learn_readout(units_of, skills, len(known), rng)
    model.restore({**model.learned_, "W_K": W_K, "b_K": b_K}, tuple(map(str, known)))
    return memory


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
    rng = np.random.default_rng(memory.seed)
    with threadpool_limits(1):
        situations, commands = next_commands(model.senses_, episodes)
        motor = learn_motor(situations, commands, units, rng)
    model.restore({**model.learned_, **motor.named()}, model.skills_)
    return memory


def next_commands(
    senses: StreamScaler, episodes: Sequence[Episode]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return situations (N, I), and the next command in each (N, A): of ``actions``, or else of the stream.

    Actions are what was intended where noise was added (DART: Laskey et al. 2017, CoRL). Raises ValueError without any.
    """
    motor = senses.spec.motor
    if not len(motor):
        raise ValueError(
            f"nothing is commanded in this stream; it has: {', '.join(senses.spec.slices)}"
        )
    situations = []
    commands = []
    for episode in episodes:
        intended = episode.actions
        if len(intended) != len(episode):
            intended = episode.stream[:, motor]
        situations.append(situation(senses, episode.stream[:-1]))
        commands.append(intended[1:].astype(np.float32))
    return np.concatenate(situations), np.concatenate(commands)


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
