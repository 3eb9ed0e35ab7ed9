"""Environments that several tests share: making one costs more than an episode."""

import gymnasium as gym
import pytest

import asm_gym  # noqa: F401


@pytest.fixture(scope="session")
def lift():
    """A Lift environment; a test must reset it before use, and leave nothing behind."""
    env = gym.make("asm_gym/Lift-v0")
    yield env
    env.close()


@pytest.fixture(scope="module")
def kept_scene(request):
    """A scene of the task that ``tests.scenes.of`` names; ``scene`` begins an episode in it."""
    from tests.scenes import Scene

    scene = Scene(request.param)
    yield scene
    scene.env.close()


@pytest.fixture
def scene(kept_scene):
    """At the beginning of an episode, always the same one."""
    kept_scene.reset()
    return kept_scene
