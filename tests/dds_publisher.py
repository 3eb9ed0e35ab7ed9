"""Publishes ``/joint_states`` of the synthetic arm over DDS, with types of its own, as a driver of ROS 2 would.

    python -m tests.dds_publisher --seconds 10 --every 5

prints stamp and moment of each fault that begins.
"""

import argparse
import json
import os
import time
from dataclasses import dataclass

import numpy as np
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from tests.dds_arm import AT, FAULT_S, NAMES, RATE, SLIP, arm


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    """A stamp."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    """When, and in which frame."""

    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    """Of sensor_msgs."""

    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Text(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    """Of std_msgs."""

    data: str


def main() -> None:
    """Publishes, in real time."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--topic", default="/joint_states")
    options.add_argument("--rate", type=float, default=RATE)
    options.add_argument("--seconds", type=float, default=10.0)
    options.add_argument("--every", type=float, default=0.0, help="seconds from fault to fault; 0 for none")
    options.add_argument("--clock", type=float, default=0.0, help="where its clock begins, if not at 1970")
    options.add_argument("--text", action="store_true", help="publish words instead")
    args = options.parse_args()
    participant = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", "0")))
    writer = DataWriter(participant, Topic(participant, f"rt{args.topic}", Text if args.text else JointState))
    print("up", flush=True)
    base, start = args.clock or time.time(), time.perf_counter()
    rng = np.random.default_rng(int(1e6 * time.time()))
    first = int(rng.integers(0, 100_000))
    for k in range(int(args.seconds * args.rate)):
        said = arm(first + k, rng, args.rate)
        every = int(args.every * args.rate)
        begun = k % every if every and k >= every else args.rate
        said[0, AT] += SLIP if begun < FAULT_S * args.rate else 0.0
        stamp = base + k / args.rate
        header = Header(Time(int(stamp), int(1e9 * (stamp % 1))), "")
        message = JointState(header, NAMES, *(part.tolist() for part in said))
        writer.write(Text("good morning") if args.text else message)
        if begun == 0:
            print(json.dumps({"stamp": stamp, "written": time.time()}), flush=True)
        time.sleep(max(0.0, start + (k + 1) / args.rate - time.perf_counter()))


if __name__ == "__main__":
    main()
