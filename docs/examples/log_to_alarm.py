"""From logs to an alarm: write logs of a healthy arm, learn from them, and watch one whose encoder froze."""

from pathlib import Path

import numpy as np
import pandas as pd

from asm_gym.scripts.cli import main  # the same as `asm-gym fit …` and `asm-gym watch …` in a shell


def log(seed):
    """Two joints that follow commands at 50 Hz; a column for each number, with its unit."""
    rng, time = np.random.default_rng(seed), np.arange(400) / 50
    command = np.sin(time[:, None] * [1.0, 1.7] + rng.uniform(0, 6, 2))
    position = np.cumsum(command, axis=0) / 50 + 1e-3 * rng.normal(size=(400, 2))
    names = ["time [s]", "q_0 [rad]", "q_1 [rad]", "cmd_0 [rad/s]", "cmd_1 [rad/s]"]
    return pd.DataFrame(np.column_stack([time, position, command]), columns=names)


Path("logs").mkdir(exist_ok=True)
for seed in range(30):
    log(seed).to_csv(f"logs/{seed:02}.csv", index=False)
broken = log(1000)
broken.loc[200:, "q_0 [rad]"] = broken["q_0 [rad]"][200]
broken.to_csv("broken.csv", index=False)

main(
    ["fit", "logs", "--out", "arm.asm", "--action", "cmd*", "--monitor", "kalman+evidence", "--false-alarm-rate", "0.1"]
)
found = main(["watch", "broken.csv", "--monitor", "arm.asm", "--out", "report"])  # writes alarms.csv and report.html
print("alarm" if found == 1 else "no alarm")
