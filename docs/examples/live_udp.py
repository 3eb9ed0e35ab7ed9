"""Watch a live robot: one program sends its rows as JSON by UDP, ``asm-gym watch`` raises the alarm."""

import json
import socket
import subprocess
import sys
import time

from asm_gym import collect, make_monitor

ARM = "asm_gym/SyntheticArm-v0"  # stands for your robot, at 100 Hz
episodes = collect(ARM, "scripted", episodes=40, workers=1, horizon=1000)
monitor = make_monitor("kalman+evidence", episodes[0].spec).fit(episodes[:20])
monitor.calibrate(episodes[20:], false_alarm_rate=0.05).save("live_udp.asm")
(live,) = collect(ARM, "scripted", episodes=1, seed=1, workers=1, horizon=6000)  # a minute

command = "-m asm_gym watch udp:9870 --monitor live_udp.asm --json --until-alarm"
watching = subprocess.Popen([sys.executable, *command.split()], stdout=subprocess.PIPE, text=True)
sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for step, row in enumerate(live.stream.astype(float)):
    if step > 3000:
        row[3] = 0.5  # an encoder is stuck
    message = {"time": 0.01 * step} | dict(zip(episodes[0].spec.labels, row.tolist()))
    sender.sendto(json.dumps(message).encode(), ("127.0.0.1", 9870))
    if watching.poll() is not None:  # at the first alarm
        break
    time.sleep(0.01)
print(watching.stdout.read())
