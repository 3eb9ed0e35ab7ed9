"""Episodes put together: what the ideal reflex is told, and what it is not."""

import numpy as np

from asm_gym.rollouts.staging import staged
from asm_gym.rollouts.trial import RolloutConfig, Trial


def test_the_ideal_reflex_stays_while_something_touches_and_is_told_no_lies():
    collision, biased = (
        Trial("asm_gym/Lift-v0", 3, kind, "strong", onset=20, acting="ideal") for kind in ("collision", "encoder_bias")
    )
    with staged(collision, RolloutConfig()) as env:
        env.reset(seed=3)
        act = np.array([0.3, 0, 0, 0, 0, 0, 1], np.float32)
        spec = env.unwrapped.stream_spec
        done = [env.step(act)[4]["stream"][spec.slices["action"]][0] for _ in range(45)]
    np.testing.assert_allclose(done, [0.3] * 20 + [0.0] * 20 + [0.3] * 5)
    with staged(biased, RolloutConfig()) as env:
        assert "FaultInjection" not in str(env)
