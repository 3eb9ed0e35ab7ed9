"""How high the surprise of a shipped memory rises in healthy episodes and under two faults: the check of its card.

python docs/checks/shipped.py Panda
python docs/checks/shipped.py Panda 100   that of 100 Hz
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym

from asm_gym.faults import FrozenEncoder, Push
from asm_gym.policies import make_policy, rollout
from asm_gym.wrappers import FaultInjection, NeuralASMSafety

ONSET, HORIZON = 30, 50
CASES = {
    "healthy": [],
    "push of 10 N": [Push(body="robot0_right_hand", newtons=10.0, onset=ONSET, duration=10)],
    "frozen encoder": [FrozenEncoder(joint=1, onset=ONSET)],
}


def main(robot: str, hz: str | None = None) -> None:
    for case, faults in CASES.items():
        base = gym.make("asm_gym/Lift-v0", robot=robot, horizon=HORIZON, stream_freq=int(hz) if hz else None)
        env = NeuralASMSafety(FaultInjection(base, faults), on_alarm="monitor", on_overrun="ignore")
        infos: list[Any] = []
        rollout(env, make_policy("scripted", env, seed=2), 2, infos.append)
        share = [info["asm"]["surprise"] / env.threshold for info in infos]
        print(f"Lift, {case}: {max(share[:ONSET]):.2f} of the threshold, {max(share[ONSET:]):.2f} from the onset on")
        env.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
