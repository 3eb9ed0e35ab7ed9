"""What a monitor says that it sees, on held-out pieces."""

from __future__ import annotations

import numpy as np

from asm_gym.data.episode import Episode
from asm_gym.data.training_selection import pieces
from asm_gym.monitors import make_monitor
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.sight import MOST, PLACES, expected_share, first_alarm, seen_again, sights
from tests.streams import pendulum_columns


def test_an_error_that_a_monitor_says_it_sees_is_found_on_held_out_pieces_and_a_tenth_of_it_is_not():
    cut = pieces(Episode.from_table(pendulum_columns(8000)), 1.0)
    monitor = make_monitor("association_values", cut[0].spec).fit(cut[:40])
    monitor.calibrate(cut[40:60], 0.06)
    by_label = {sight.label: sight for sight in sights(monitor, cut[40:60])}
    assert {"effort[0]", "effort[1]", "position[0]", "position[1]"} == set(by_label)
    torque = by_label["effort[0]"]
    small = torque._replace(size=torque.size / 10)
    held_out = cut[60:80]
    assert seen_again(monitor, [torque], held_out).mean() >= 0.6
    assert seen_again(monitor, [small], held_out).mean() <= 0.3


def test_of_five_places_all_show_what_a_monitor_says_it_sees_and_of_ten_nine():
    assert expected_share(np.ones(10)) >= MOST
    assert expected_share(np.arange(10) > 0) < MOST
    assert expected_share(np.arange(20) > 1) >= MOST
    assert expected_share(np.arange(20) > 3) < MOST


def test_places_that_are_in_alarm_before_an_error_say_nothing_of_it():
    cut = pieces(Episode.from_table(pendulum_columns(8000)), 1.0)
    monitor = make_monitor("association_values", cut[0].spec).fit(cut[:40])
    monitor.calibrate(cut[40:60], 0.06)
    torque = {sight.label: sight for sight in sights(monitor, cut[40:60])}["effort[0]"]
    column = monitor.spec.labels.index("effort[0]")
    usual = sorted(cut[40:60], key=lambda piece: monitor.score(piece).value.max())[:PLACES]
    assert seen_again(monitor, [torque], usual).tolist() == [True] * 2 * PLACES
    broken = usual[0].stream.copy()
    broken[:, column] += 10 * torque.size
    with_alarm = [Episode.from_stream(broken, monitor.spec), *usual[1:]]
    assert seen_again(monitor, [torque], with_alarm).tolist() == [True] * 2 * (PLACES - 1)


def test_an_alarm_before_the_onset_hides_what_comes_after_it():
    def score(*values: float) -> Surprise:
        return Surprise(np.array(values), np.zeros((len(values), 1)))

    assert first_alarm(score(0, 0, 2, 2), 1.0, 1) == 2
    assert first_alarm(score(2, 0, 2, 2), 1.0, 1) is None
    assert first_alarm(score(0, 0, 1, 1), 1.0, 1) is None
