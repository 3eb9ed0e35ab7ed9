"""Film a push and a frozen encoder under the guard: ``python docs/examples/film_an_alarm.py film.gif``.

A red frame is an alarm, an orange one a reflex that still acts, a golden one a sensor that is completed.
"""

import sys

import gymnasium as gym
from PIL import Image, ImageDraw, ImageOps

from asm_gym import FaultInjection, NeuralASMSafety, make_policy
from asm_gym.faults import FrozenEncoder, Push

lift = gym.make("asm_gym/Lift-v0", render_mode="rgb_array")
env = NeuralASMSafety(
    FaultInjection(lift, [Push(newtons=60, onset=12, duration=10), FrozenEncoder(onset=32)])
)
policy, (observation, info) = make_policy("lift_sac", env), env.reset(seed=0)
pictures = []
for step in range(100):
    observation, reward, terminated, truncated, info = env.step(policy.predict(observation)[0])
    if step % 2:
        continue
    asm = info["asm"]
    colour = "white"
    for key, marked in {"completed": "gold", "intervened": "orange", "alarm": "red"}.items():
        if asm[key]:
            colour = marked  # the last that holds is the gravest
    picture = ImageOps.expand(Image.fromarray(env.render()).resize((320, 320)), 8, colour)
    fault, doing = ", ".join(info["fault"]) or "no fault", asm["response"] or asm["state"]
    doing = " ".join([doing, *asm["completed"], "is completed"]) if asm["completed"] else doing
    surprise = asm["surprise"] / asm["threshold"]
    said = f"{step / 20:.1f} s: {fault}\nsurprise {surprise:.1f} thresholds\n{doing}"
    ImageDraw.Draw(picture).text((16, 14), said, "white")
    pictures.append(picture.quantize(64))
pictures[0].save(
    [*sys.argv, "film.gif"][1], save_all=True, append_images=pictures[1:], duration=100, loop=0
)
print(f"solved: {info['success']}")
