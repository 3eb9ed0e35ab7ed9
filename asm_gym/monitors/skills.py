"""Skills of a memory: their names, and the surprise at how a skill goes on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.episode import Episode
from asm_gym.memory.association import hidden_units
from asm_gym.memory.readout import learn_readout
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.monitors.skill_surprise import ALARMS_ON, BODY, SkillSurprise
from asm_gym.monitors.stream_model import model_outputs
from asm_gym.monitors.training_data import check_nominal
from asm_gym.validation import check_choice, check_number, short_repr


def learn_skills(memory: NeuralASM, episodes: Sequence[Episode]) -> NeuralASM:
    """Learn how the skills of the guarded policy go on, so that each row has a skill surprise too; return the memory.

    The surprise of the body, its threshold and its alarms stay as they are: ``with_alarm_on`` chooses others.

    Args:
        memory: fitted, which alarms on the body; it is changed.
        episodes: nominal ones, of one skill or many; those of ``fit`` will do.

    Raises:
        RuntimeError: the memory has not learned anything yet.
        ValueError: as ``fit``; or there are more channels than can be weighed against all traces.
    """
    memory._require_fitted()
    check_nominal(episodes, memory.spec, memory.model.shortest)
    if memory.alarm_on_ != BODY:
        raise ValueError(f"this memory alarms on {memory.alarm_on_!r}: take with_alarm_on(memory, {BODY!r})")
    memory.skill_ = None
    memory.skill_ = SkillSurprise.learned(episodes, memory.score_episodes(episodes), memory.seed)
    memory._remember(episodes)
    return memory


def with_alarm_on(memory: NeuralASM, which: str) -> NeuralASM:
    """Return the same memory with alarms on another surprise, without a threshold: ``calibrate`` it.

    Args:
        memory: fitted; it keeps its own.
        which: ``"body"`` or ``"skill"``; ``"either"`` goes by the larger of the two, ``"both"`` by the smaller.

    Raises:
        ValueError: an unknown name; the message lists what exists.
        RuntimeError: the skills have not been learned yet: ``learn_skills`` comes first.
    """
    check_choice("alarm_on", which, ALARMS_ON)
    other = memory._copy()
    if which == memory.alarm_on_:
        return other
    if memory.skill_ is None:
        raise RuntimeError(f"alarm_on={which!r} takes a skill surprise: call learn_skills(memory, episodes) first")
    other.about = {**memory.about, "alarm_on": which}
    other._uncalibrate()
    return other


def name_skills(memory: NeuralASM, episodes: Sequence[Episode]) -> NeuralASM:
    """Learn to tell which skill is running, from episodes that name it, and return the memory.

    ``info["skill"]`` is the skill of a whole episode. Of one in which skills follow each other, ``info["skills"]``
    names them in order, and ``info["changed"]`` says in which row each next one begins (a number, or a list of them).
    Episodes with such changes let it follow a change sooner. Only ``surprise.skill`` depends on it.

    Args:
        memory: fitted; it is changed.
        episodes: nominal ones.

    Raises:
        ValueError: an episode names none, or rows in which nothing can change; or all name the same.
    """
    memory._require_fitted()
    check_nominal(episodes, memory.spec, memory.model.shortest)
    names, model = [], memory.model
    for n, episode in enumerate(episodes):
        try:
            names.append(skills_of(episode))
        except ValueError as error:
            raise ValueError(f"episode {n} {error}") from error
    known, skills = np.unique(np.concatenate(names), return_inverse=True)
    if len(known) < 2:
        raise ValueError(f"two skills at least are needed to tell them apart, got {', '.join(known)}")
    inputs = np.concatenate([model.senses_.read_episode(e.stream).inputs for e in episodes])
    V = model.network.association.V
    with threadpool_limits(1):
        states = np.concatenate([o.contexts for o in model_outputs(model, episodes)])

        def units(chosen: NDArray[np.intp]) -> NDArray[np.float32]:
            return np.hstack([hidden_units(inputs[chosen], V), states[chosen]])

        W_K, b_K = learn_readout(units, skills, len(known), np.random.default_rng(memory.seed))
    model.restore({**model.learned_, "W_K": W_K, "b_K": b_K}, tuple(map(str, known)))
    return memory


def named_skills(memory: NeuralASM, stream: NDArray[np.floating[Any]]) -> NDArray[np.str_]:
    """Return the skill (T,) that seems to run in each step of a stream (T, D), by the rows before it.

    Raises:
        RuntimeError: no skill has a name: ``name_skills`` comes first.
    """
    if not memory.skills_:
        raise RuntimeError("no skill has a name yet: call name_skills(memory, episodes) first")
    model, named = memory.model, []
    state = model.start(1)
    for row in np.asarray(stream, np.float64):
        state, _ = model.predict(state, row[None])
        named.append(memory.skills_[int(state.skill.argmax())])
    return np.array(named)


def skills_of(episode: Episode) -> NDArray[np.str_]:
    """Return the skill (T,) that runs in each row, as ``name_skills`` reads ``info``.

    Raises:
        ValueError: it names none; or not as many as begin; or they cannot begin there.
    """
    names = episode.info.get("skills")
    if names is None:
        name = str(episode.info.get("skill", ""))
        if not name:
            raise ValueError("does not say its skill: set info['skill']")
        return np.repeat(name, len(episode))
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"must name its skills in order, info['skills'], got {short_repr(names)}")
    changed = episode.info.get("changed", [])
    rows = changed if isinstance(changed, list | tuple) else [changed]
    begins = [0, *(check_number("info['changed']", row, low=1, whole=True) for row in rows)]
    if len(begins) != len(names):
        raise ValueError(f"names {len(names)} skills, and says of {len(begins) - 1} where they begin: info['changed']")
    lengths = np.diff([*begins, len(episode)])
    if (lengths < 1).any():
        raise ValueError(f"has {len(episode)} rows, in which skills cannot begin at {', '.join(map(str, begins))}")
    return np.repeat(names, lengths)
