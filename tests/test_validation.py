"""Arguments at the edge: what passes for a number, and what a refusal says."""

import math
from fractions import Fraction

import numpy as np
import pytest

from asm_gym.validation import as_float32, check_flag, check_number, check_numbers, check_text


@pytest.mark.parametrize(
    "value", [True, np.True_, None, "1", 1j, [1.0], np.zeros(1), np.array(1.0), math.nan, np.nan]
)
def test_what_is_no_number_is_refused_by_name(value):
    with pytest.raises(ValueError, match=r"^gain must be a number, got "):
        check_number("gain", value)


@pytest.mark.parametrize(
    ("value", "kind"), [(3, int), (np.int16(3), int), (3.0, float), (np.float32(3), float)]
)
def test_numbers_of_numpy_come_back_as_those_of_python(value, kind):
    number = check_number("gain", value, low=3, high=3)
    assert number == 3
    assert type(number) is kind
    assert check_number("gain", Fraction(1, 2)) == 0.5


def test_bounds_hold_at_their_edges_and_are_named():
    for bounds, inside, outside, message in (
        ({"low": 0}, 0, -1, "rate must be a number of at least 0, got -1"),
        ({"above": 0}, 1e-300, 0, "rate must be a number above 0, got 0"),
        ({"high": 2}, 2, 2.5, "rate must be a number of at most 2, got 2.5"),
        ({"below": 2}, 1.5, 2, "rate must be a number below 2, got 2"),
        ({"above": 0, "high": 1}, 1, 0, "rate must be a number in (0, 1], got 0"),
        ({"low": 0, "below": 1}, 0, 1.0, "rate must be a number in [0, 1), got 1.0"),
    ):
        assert check_number("rate", inside, **bounds) == inside
        with pytest.raises(ValueError) as refused:  # noqa: PT011 (the whole message is compared)
            check_number("rate", outside, **bounds)
        assert str(refused.value) == message


@pytest.mark.parametrize("value", [1.5, 2.0, np.float64(2), "2", False])
def test_only_integers_are_whole(value):
    with pytest.raises(ValueError, match="steps must be a whole number of at least 1, got"):
        check_number("steps", value, low=1, whole=True)


def test_infinity_passes_only_where_it_is_asked_for():
    assert check_number("until", math.inf, infinite=True) == math.inf
    for value in (math.inf, -math.inf, 10**400):
        with pytest.raises(ValueError, match="until must be finite, got"):
            check_number("until", value)
    with pytest.raises(ValueError, match="thousands of digits"):
        check_number("until", 10**5000)


def test_arrays_are_refused_by_shape_kind_and_by_any_one_number():
    np.testing.assert_array_equal(check_numbers("offset", (1, 2, 3), 3), [1.0, 2.0, 3.0])
    for values in (
        (1, 2),
        ((1, 2, 3),),
        "abc",
        None,
        (1, None, 2),
        ((1,), (1, 2)),
        (True, False, True),
        1.0,
    ):
        with pytest.raises(
            ValueError, match=r"offset must be finite numbers in the shape \(3,\), got"
        ):
            check_numbers("offset", values, 3)
    for bad in (math.nan, math.inf, -1):
        with pytest.raises(ValueError, match="among them"):
            check_numbers("offset", (1, bad, 3), 3, low=0)


def test_names_and_flags_are_what_they_say():
    assert check_text("body", "robot0_link5") == "robot0_link5"
    assert check_flag("noisy", np.False_) is False
    for value in (None, "", 3, b"x"):
        with pytest.raises(ValueError, match="body must be a name"):
            check_text("body", value)
    for value in (None, 0, 1, "True"):
        with pytest.raises(ValueError, match="noisy must be True or False"):
            check_flag("noisy", value)


def test_what_is_too_large_for_a_stream_is_infinite_without_a_warning(recwarn):
    np.testing.assert_array_equal(
        as_float32([1e39, -1e300, 0.5]), np.float32([np.inf, -np.inf, 0.5])
    )
    assert not recwarn.list


@pytest.mark.parametrize("values", ["hold", ("a", "b"), None, {}, [[1], [2, 3]], object()])
def test_what_is_no_array_of_numbers_is_refused_by_name(values):
    if values is None:  # as numbers that are missing
        assert np.isnan(as_float32(values, "an action"))
        return
    with pytest.raises(ValueError, match="an action must be numbers, got"):
        as_float32(values, "an action")
