"""Defaults of an evaluation: the detection window, and the false-alarm rates."""

WINDOW_S = 1.0  # a fault counts as found within this time of its onset [s]

FALSE_ALARM_RATE = 0.05
"""Share of nominal episodes that may raise an alarm where little is recorded: needs 19 calibration episodes."""

REPORTED_RATE = 0.01  # the same in the tables that compare monitors: needs 99 calibration episodes
RATES = (0.005, REPORTED_RATE, FALSE_ALARM_RATE)  # false-alarm rates at which detection is compared
PER_HOUR = (10.0, 1.0)  # the same as false alarms per hour, where there are enough hours
# What a hand or finger may be pressed with for a moment [N] (ISO/TS 15066:2016, Table A.2).
TRANSIENT = 280.0
