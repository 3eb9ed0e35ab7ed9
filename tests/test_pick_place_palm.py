"""A palm that comes down on what lies low in a bin stays off the walls, where it can."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asm_gym.policies.scripted.pick_place import _ASKEW, _PALM, _SPARE, PickPlaceExpert

BREAD = np.array([0.024, 0.02, 0.024])
BIN_AT, BIN = np.array([0.1, -0.25, 0.8]), np.array([0.39, 0.49, 0.82])


def lying(x, y, heading):
    c, s = np.cos(heading), np.sin(heading)
    return np.array([x, y, 0.845]), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def chosen(x, y, heading):
    at, turned = lying(x, y, heading)
    closing, room = PickPlaceExpert._beside_walls(BREAD, at, turned, BIN_AT, BIN)
    return closing, room, at, turned


def corners(closing, at, turned):
    """(4, 2) of the palm over the table."""
    along = (turned @ closing)[:2]
    across = np.array([-along[1], along[0]])
    return np.array([at[:2] + a * _PALM[0] * along + b * _PALM[1] * across for a in (-1, 1) for b in (-1, 1)])


places = st.floats(-0.05, 0.25), st.floats(-0.45, -0.05), st.floats(-np.pi, np.pi)


@given(*places)
def test_what_room_there_is_said_to_be_is_there(x, y, heading):
    closing, room, at, turned = chosen(x, y, heading)
    beyond = np.abs(corners(closing, at, turned) - BIN_AT[:2]) - BIN[:2] / 2
    assert -beyond.max() == pytest.approx(room, abs=1e-9)
    askew = abs(np.arctan2(closing[1], closing[0])) % (np.pi / 2)
    assert min(askew, np.pi / 2 - askew) <= max(_ASKEW) + 1e-9


@given(*places)
def test_fingers_close_askew_only_where_that_makes_the_room(x, y, heading):
    closing, room, *_ = chosen(x, y, heading)
    if np.abs(closing).max() < 1 - 1e-9:
        assert room >= _SPARE


@pytest.mark.parametrize(
    ("x", "y", "heading", "room", "square"),
    [
        (0.1, -0.25, 0.3, True, True),  # in the middle
        (0.0, -0.25, np.pi / 4, True, False),  # by one wall, at an angle
        (0.207, -0.097, 0.0, False, True),  # in a corner, where no way is free
    ],
)
def test_in_the_middle_by_a_wall_and_in_a_corner(x, y, heading, room, square):
    closing, free, *_ = chosen(x, y, heading)
    assert (free >= _SPARE) == room
    assert (np.abs(closing).max() > 1 - 1e-9) == square
