"""Messages of ROS 2 as a driver would publish them over DDS, written without the types that are tested."""

from dataclasses import dataclass

from tests.needs import needs

idl, types = needs("cyclonedds.idl"), needs("cyclonedds.idl.types")


@dataclass
class Time(idl.IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    """A stamp."""

    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(idl.IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    """Of std_msgs."""

    stamp: Time
    frame_id: str


@dataclass
class JointState(idl.IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    """Of sensor_msgs."""

    header: Header
    name: types.sequence[str]
    position: types.sequence[types.float64]
    velocity: types.sequence[types.float64]
    effort: types.sequence[types.float64]


@dataclass
class Text(idl.IdlStruct, typename="std_msgs.msg.dds_.String_"):
    """Of std_msgs."""

    data: str
