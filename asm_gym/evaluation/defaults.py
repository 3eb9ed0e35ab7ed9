"""What is judged by default: how soon a fault must be noticed, and how often nothing may raise an alarm."""

WINDOW_S = 1.0
"""How soon after its onset a fault must be noticed to count as found [s]."""

FALSE_ALARM_RATE = 0.05
"""Share of nominal episodes that may raise an alarm, where little is recorded: 19 episodes can promise it."""

REPORTED_RATE = 0.01
"""The same where much is recorded, as in the tables that compare monitors: 99 episodes can promise it."""

RATES = (0.005, REPORTED_RATE, FALSE_ALARM_RATE)
"""Shares of nominal episodes with an alarm, at which detection is compared."""

PER_HOUR = (10.0, 1.0)
"""False alarms in an hour of nominal episodes, at which it is compared too where there are hours enough."""
