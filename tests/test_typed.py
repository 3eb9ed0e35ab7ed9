"""Arguments of other types than annotated are refused by name, before anything is done."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asm_gym.policies.policy import Policy
from asm_gym.validation import ArgumentTypeError, typed

Policies = str | Path | Policy | Callable[[object], Policy]


@typed
def call(
    path: str | Path,
    count: int = 1,
    share: float | None = None,
    names: Sequence[str] = (),
    on: bool = False,
    then: Callable[[], None] | None = None,
    *rest: int,
    anything: Any = None,
    array: np.ndarray | None = None,
    **more: int,
) -> Path:
    return Path(path)


@pytest.mark.parametrize(
    "arguments",
    [
        {"path": Path("a"), "count": np.int64(3), "share": np.float32(0.5), "names": ["a", "b"]},
        {
            "path": "a",
            "share": 1,
            "names": np.array(["a"]),
            "on": np.True_,
            "then": list,
            "more": "what it likes",
        },
        {"path": "a", "anything": object(), "array": [1, 2]},
    ],
)
def test_what_an_annotation_says_is_taken(arguments):
    assert call(**arguments) == Path("a")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("path", bad) for bad in (None, 3, b"a", np.zeros(3), ["a"])),
        *(
            ("names", bad)
            for bad in ("ab", None, [1], ("a", None), {"a"}, np.array("a"), iter("ab"))
        ),
        ("then", 3),
    ],
)
def test_any_other_type_is_refused_by_name_and_value(name, value):
    with pytest.raises(ArgumentTypeError, match=rf"^{name} must be .*, got "):
        call(**({"path": "a"} | {name: value}))


@typed
def act(policy: Policies) -> None: ...


def test_an_alias_of_several_types_is_spelled_out():
    with pytest.raises(
        ArgumentTypeError, match=r"^policy must be (?!Policies).*predict\(\).*, got <obj"
    ):
        act(object())


def test_a_function_keeps_its_name_and_its_own_errors():
    assert call.__name__ == "call"
    with pytest.raises(TypeError, match="missing a required argument: 'path'"):
        call()
