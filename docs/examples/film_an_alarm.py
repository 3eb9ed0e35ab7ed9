"""Film a push and the guard's response: MUJOCO_GL=egl python docs/examples/film_an_alarm.py film.gif

A red frame is an alarm, an orange one a reflex that still acts.
"""

import sys

import gymnasium as gym
from PIL import Image, ImageDraw, ImageOps

from asm_gym import FaultInjection, NeuralASMSafety, make_policy
from asm_gym.faults import FrozenEncoder, Push

SIZE, EVERY = 320, 2  # of a picture [pixels]; steps between pictures
FAULTS = [Push(newtons=60, onset=12, duration=10), FrozenEncoder(joint=3, onset=60)]

lift = gym.make("asm_gym/Lift-v0", render_mode="rgb_array")
env = NeuralASMSafety(FaultInjection(lift, FAULTS))
policy, (observation, info) = make_policy("lift_sac", env), env.reset(seed=0)
pictures = []
for step in range(100):
    observation, reward, terminated, truncated, info = env.step(policy.predict(observation)[0])
    if step % EVERY:
        continue
    asm = info["asm"]
    colour = "red" if asm["alarm"] else "orange" if asm["intervened"] else "white"
    picture = ImageOps.expand(Image.fromarray(env.render()).resize((SIZE, SIZE)), 8, colour)
    fault, doing = ", ".join(info["fault"]) or "no fault", asm["response"] or asm["state"]
    surprise = asm["surprise"] / asm["threshold"]
    ImageDraw.Draw(picture).text(
        (16, 14), f"{step / 20:.1f} s  {fault}\nsurprise {surprise:.1f} thresholds\n{doing}", "white"
    )
    pictures.append(picture)
target = sys.argv[1] if len(sys.argv) > 1 else "film.gif"
first, *others = (picture.quantize(64) for picture in pictures)
first.save(target, save_all=True, append_images=others, duration=1000 * EVERY // 20, loop=0)
print(f"{len(pictures)} pictures in {target}; solved: {info['success']}")
