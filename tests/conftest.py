"""Environments that several tests share: making one costs more than an episode."""

import resource

import gymnasium as gym
import pytest

import asm_gym  # noqa: F401


@pytest.fixture(scope="session")
def lift():
    """A Lift environment; a test must reset it before use, and leave nothing behind."""
    env = gym.make("asm_gym/Lift-v0")
    yield env
    env.close()


@pytest.fixture
def small_disk():
    """Lets no file grow beyond 100 KB: what is written to one fails as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
