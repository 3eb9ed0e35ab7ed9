"""Shapes that are drawn into a loaded model, against robosuite's own loading."""

import gymnasium as gym
import numpy as np
import pytest

import asm_gym  # noqa: F401
from asm_gym.envs import lift_cube


def numbers(model):
    """Every number of a model but the pictures on its surfaces."""
    arrays = {n: getattr(model, n) for n in dir(model) if not n.startswith(("_", "tex_data"))}
    found = {n: a.tobytes() for n, a in arrays.items() if isinstance(a, np.ndarray)}
    statistics = ("center", "extent", "meaninertia", "meanmass", "meansize")
    return found | {n: np.array(getattr(model.stat, n)).tobytes() for n in statistics}


def episode(env, seed, steps=8):
    """The numbers of the model at the beginning, then all that an episode of random actions shows."""
    observation, info = env.reset(seed=seed)
    env = env.unwrapped
    shown, data = (
        [numbers(env.simulation.model), observation.tobytes(), info["stream"].tobytes()],
        env.simulation.data,
    )
    for action in (
        np.random.default_rng(seed)
        .uniform(-1, 1, (steps, *env.action_space.shape))
        .astype(np.float32)
    ):
        observation, reward, _, _, info = env.step(action)
        state = data.qpos, data.qvel, data.qacc_warmstart, observation, info["stream"]
        shown.append((reward, info["contact_force"], *(a.tobytes() for a in state)))
    return shown


def loads_anew(env, seed):
    before = env.unwrapped.simulation.model
    env.reset(seed=seed)
    return env.unwrapped.simulation.model is not before


@pytest.mark.parametrize("seeds", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_what_is_drawn_into_a_model_is_what_loading_draws(seeds, monkeypatch):
    loaded, drawn = (gym.make("asm_gym/Lift-v0") for _ in range(2))
    drawn.reset(seed=1000)
    sizes = set()
    for seed in range(seeds):
        with monkeypatch.context() as patch:
            patch.setattr(lift_cube, "draw", lambda env: False)
            expected = episode(loaded, seed)
        before = drawn.unwrapped.simulation.model
        assert episode(drawn, seed) == expected
        assert drawn.unwrapped.simulation.model is before
        sizes.add(expected[0]["geom_size"])
    assert len(sizes) == seeds
    loaded.close()
    drawn.close()


def test_a_model_that_others_edit_is_loaded_anew():
    lift = gym.make("asm_gym/Lift-v0")
    lift.reset(seed=0)
    assert not loads_anew(lift, 0)
    inner = lift.unwrapped
    with inner.edits.edit(inner.simulation.model.geom_friction, 0):
        assert loads_anew(lift, 0)
    assert not loads_anew(lift, 0)
    inner.simulation.model.body_mass[inner.simulation.model.body("robot0_link5").id] += 1.0
    assert loads_anew(lift, 0)
    assert not loads_anew(lift, 0)
    inner.robosuite_env.set_xml_processor(
        lambda text: text.replace('name="cube_main"', 'name="cube_main" gravcomp="1"')
    )
    assert loads_anew(lift, 0)
    model = inner.simulation.model
    assert model.body_gravcomp[model.body("cube_main").id] == 1
    inner.robosuite_env._xml_processors.pop()
    lift.close()
