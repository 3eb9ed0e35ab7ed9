"""Tasks, faults, monitors and policies of one's own: one shape, and known in worker processes."""

from __future__ import annotations

import numpy as np
import pytest

import asm_gym
from asm_gym import collect, register_fault, register_policy, register_task
from asm_gym.faults import Push
from asm_gym.faults.suite import KINDS
from asm_gym.monitors import MONITORS
from asm_gym.policies.registry import POLICIES
from asm_gym.registries import added
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.synthetic_arm import SyntheticArm
from asm_gym.tasks import OWN, env_id
from tests.models import Persistence


class Still:
    """Commands nothing."""

    def __init__(self, env, seed=None):
        self.action = np.zeros(env.action_space.shape, np.float32)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return self.action, state


@pytest.fixture(autouse=True)
def registries():
    kept = [(rows, dict(rows)) for rows in (KINDS, MONITORS, OWN, POLICIES)]
    yield
    for rows, before in kept:
        rows.clear()
        rows.update(before)


def known(name: str) -> list[bool]:
    """What a process knows of a name."""
    return [name in rows for rows in (KINDS, MONITORS, OWN, POLICIES)]


def test_what_is_registered_is_known_in_worker_processes_and_what_is_forgotten_is_not_sent():
    before = parallel_map(known, ["mine"] * 2, 2)
    assert before == [[False] * 4] * 2
    assert not any("mine" in rows for rows in added().values())
    register_task("mine", SyntheticArm, horizon=20)
    register_fault(
        "mine", lambda drawn, severity: Push(newtons=(5.0, 10.0, 20.0)[severity], onset=drawn.onset)
    )
    register_policy("mine", Still)
    MONITORS["mine"] = MONITORS["kalman"]
    assert parallel_map(known, ["mine"] * 2, 2) == [[True] * 4] * 2


def test_a_task_and_a_policy_of_ones_own_are_collected_by_workers():
    register_task("Waving", SyntheticArm, horizon=12)
    register_policy("still", Still)
    one, two = (collect(env_id("Waving"), "still", episodes=2, seed=1, workers=n) for n in (1, 2))
    assert [len(e) for e in one] == [len(e) for e in two] == [12, 12]
    np.testing.assert_array_equal(one[1].stream, two[1].stream)
    assert not one[0].actions.any()


@pytest.mark.parametrize(
    ("what", "name", "made"),
    [
        ("task", "Lift", SyntheticArm),
        ("fault", "push", Push),
        ("monitor", "gru", Persistence),
        ("policy", "scripted", Still),
        ("policy", "lift_sac", Still),
        ("policy", "", Still),
    ],
)
def test_a_name_that_is_taken_is_refused(what, name, made):
    more = {"horizon": 5} if what == "task" else {}
    with pytest.raises(ValueError, match=r"already|of the kind|must be a name"):
        getattr(asm_gym, f"register_{what}")(name, made, **more)
