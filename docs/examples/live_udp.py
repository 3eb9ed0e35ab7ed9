"""Watch a live robot: one program sends its rows as JSON by UDP, ``asm-gym watch`` raises the alarm."""

import json
import socket
import subprocess
import sys
import time

from asm_gym import collect, make_monitor

PORT, SECONDS, BROKEN = 9870, 6.0, 3.0
episodes = collect("asm_gym/SyntheticArm-v0", "scripted", episodes=41, workers=1)
monitor = make_monitor("kalman+evidence", episodes[0].spec).fit(episodes[:20])
monitor.calibrate(episodes[20:40], false_alarm_rate=0.05).save("arm.asm")

watch = [sys.executable, "-m", "asm_gym", "watch", f"udp:{PORT}", "--monitor", "arm.asm", "--json", "--silence", "1"]
watching = subprocess.Popen(watch, stdout=subprocess.PIPE, text=True)
sender, stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), episodes[40].stream  # stands for your robot
start, step = time.monotonic(), 0
while watching.poll() is None and time.monotonic() < start + 60:  # until the watch has noticed the silence
    row = stream[step % len(stream)].astype(float)
    if step > BROKEN / 0.01:
        row[3] = 0.5  # a stuck encoder
    if step < SECONDS / 0.01:
        message = {"time": 0.01 * step} | dict(zip(episodes[0].spec.labels, row.tolist(), strict=True))
        sender.sendto(json.dumps(message).encode(), ("127.0.0.1", PORT))
        step += 1
    time.sleep(0.01)
print(watching.stdout.read())  # a line for each alarm
