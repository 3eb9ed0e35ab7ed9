"""Judge the values of senses, such as torques, beside their changes: for pushes that are held."""

from __future__ import annotations

from asm_gym.monitors.torque.value_judge import ValueJudge as ValueJudge
