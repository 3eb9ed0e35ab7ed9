"""Write a model of your own: it predicts rows, and this package's detection turns its errors into alarms."""

from typing import NamedTuple

import numpy as np

from asm_gym import collect, make_monitor, register_monitor
from asm_gym.detection import ModelOutput
from asm_gym.monitors import StreamModel


class State(NamedTuple):
    senses: np.ndarray  # (B, S) of the last row of B streams


class Persistence(StreamModel):
    """Expect each sense to stay as it is: errors (x_t - x_{t-1}) / σ of nominal changes."""

    kind = "persistence"

    def fit(self, episodes, rng, progress):
        changes = np.concatenate([np.diff(e.stream[:, self.spec.sensory], axis=0) for e in episodes])
        return self.restore({"spread": np.maximum(changes.std(axis=0, dtype=np.float64), 1e-6)})

    def start(self, batch):
        return State(np.full((batch, len(self.spec.sensory)), np.nan))

    def predict(self, state, rows):
        senses = rows[:, self.spec.sensory]
        errors = np.nan_to_num((senses - state.senses) / self.learned_["spread"])  # (B, S)
        return State(senses), ModelOutput(errors, np.zeros((len(rows), 0)))


register_monitor("persistence", Persistence)  # `asm-gym evaluate --monitors package:Persistence` compares it
episodes = collect("asm_gym/SyntheticArm-v0", "scripted", episodes=40, workers=1, horizon=100)
monitor = make_monitor("persistence", episodes[0].spec).fit(episodes[:20])
print(monitor.calibrate(episodes[20:], false_alarm_rate=0.05).promise)
