"""RAPT: a recurrent network that says of each proprioceptive number how it will be next, and how surely.

    p(s_t | s_<t, a_<=t) = Π_i N(μ_i, σ_i²)        (s_t,i - μ_i)/σ_i, each measured by its own nominal quantile

Of a row it knows joints, torques, hand and gripper, and nothing of the wrist's sensor or of objects. An alarm is raised
by the number that is farthest out for itself, not by a sum.
Source: Munn et al. 2026 (arXiv 2602.01515), as its abstract and second-hand accounts describe it: their network's
units, layers and training were not to be had, so those are ``gru``'s, as is the code; saliency and the language model
that explains alarms are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import nn

from asm_gym.monitors.baselines.gru import GRU, _Module
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec

PROPRIOCEPTION = ("joint", "torque", "hand", "gripper")
"""Groups of channels that tell of the body alone."""


class RAPT(GRU):
    """A probabilistic recurrent model of the body's own next state.

    Args:
        spec: the stream it is to expect.
        hidden_size: H, hidden units.
        learning_rate: of Adam, before the first plateau.

    Raises:
        ValueError: no channel tells of the body.
    """

    kind = "rapt"

    def __init__(self, spec: StreamSpec, hidden_size: int = 128, learning_rate: float = 1e-3) -> None:
        super().__init__(spec, hidden_size, learning_rate)
        groups = np.array([c.group for c in spec.channels for _ in range(c.size)])[spec.sensory]
        self._own = np.flatnonzero(np.isin(groups, PROPRIOCEPTION))  # of the senses
        if not len(self._own):
            raise ValueError(
                f"this stream has no channel of {', '.join(PROPRIOCEPTION)}; it has: {', '.join(spec.slices)}"
            )

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self.spec.sensory[self._own]

    def module(self, senses: StreamScaler) -> nn.Module:
        return _Module(len(self._own), len(self.spec.motor) + 1, len(self._own), self.hidden_size)

    def sensed(self, reading: ScaledRows) -> NDArray[np.float32]:
        return reading.senses[:, self._own]

    def judged(self, reading: ScaledRows) -> NDArray[np.float32]:
        return self.sensed(reading)
