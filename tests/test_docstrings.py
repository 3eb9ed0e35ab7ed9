"""Every name of the one import shows how it is used, and what it shows is so."""

from __future__ import annotations

import doctest
import inspect

import pytest

import asm_gym
from asm_gym.faults.suite import KINDS
from asm_gym.monitors import MONITORS
from asm_gym.policies.registry import REGISTERED
from asm_gym.tasks import OWN


@pytest.fixture(autouse=True)
def registries():
    """What an example registers is forgotten."""
    kept = [(rows, dict(rows)) for rows in (KINDS, MONITORS, OWN, REGISTERED)]
    yield
    for rows, before in kept:
        rows.clear()
        rows.update(before)


@pytest.mark.parametrize("name", sorted(asm_gym.__all__))
def test_the_example_of_a_public_name_runs(name):
    thing = inspect.unwrap(getattr(asm_gym, name))
    examples = doctest.DocTestParser().get_doctest(inspect.getdoc(thing) or "", {}, name, None, 0)
    assert examples.examples, f"{name} has no example"
    assert f"{name}" in (inspect.getdoc(thing) or "").partition("from asm_gym import")[2].splitlines()[0]
    said: list[str] = []
    doctest.DocTestRunner().run(examples, out=said.append)
    assert not said, "".join(said)
