"""Environments that several tests share: making one costs more than an episode."""

import gymnasium as gym
import pytest

import asm_gym  # noqa: F401
from asm_gym.envs.obstacles import Obstacles


@pytest.fixture
def surrounded(monkeypatch):
    """Let arms believe that something that does not give way is near them on all sides."""
    monkeypatch.setattr(Obstacles, "look", lambda obstacles: None)


@pytest.fixture(scope="session")
def lift():
    """A Lift environment; a test must reset it before use, and leave nothing behind."""
    env = gym.make("asm_gym/Lift-v0")
    yield env
    env.close()
