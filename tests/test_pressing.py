"""What presses decides, whatever the cause is taken for: nobody goes on against what blocks the arm."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.guard.alarm_terms import SURPRISE
from asm_gym.guard.contact_state import contact_columns, measure_contacts, no_load
from asm_gym.guard.diagnostician import Diagnostician
from asm_gym.guard.options import IMPULSE, GuardOptions
from asm_gym.guard.responses import DEFAULT
from asm_gym.guard.robot_table import RobotTable
from asm_gym.guard.row_evidence import RowEvidence
from asm_gym.memory.completion import Completion
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.scaling import StreamScaler
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.arms import ACT, Acting, Judge, Named, infos

SOLID = StreamSpec(
    (
        Channel("joint_position", 2, "rad", 0.001, "joint"),
        Channel("external_torque", 2, "N m", 0.1, "torque"),
        Channel("action", 2, group=MOTOR),
    ),
    dt=0.05,
)


class Solid(gym.Env):
    """Two joints that swing, until from step 60 on something presses the second, or not, and blocks it, or both."""

    metadata = {"render_fps": 20}  # noqa: RUF012
    dt = 0.05
    stream_spec = SOLID
    action_means = "delta"
    observation_layout = {"joint_position": 2}  # noqa: RUF012
    observation_space = gym.spaces.Box(-50, 50, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, torque=20.0, turns=0.0, others=0.0):
        self.torque, self.turns, self.others = torque, turns, others

    def row(self, action):
        swing = np.sin(0.2 * self.t + np.arange(2))
        blocked = self.t >= 60
        swing *= [self.others if blocked else 1.0, self.turns if blocked else 1.0]
        external = 0.1 * self.np_random.standard_normal(2) + np.array([0.0, self.torque * blocked])
        return np.concatenate(
            [swing + 0.001 * self.np_random.standard_normal(2), external, action]
        ).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2, np.float32), {"stream": self.row(np.zeros(2))}

    def step(self, action):
        self.t += 1
        row = self.row(action)
        return row[:2], 0.0, False, False, {"stream": row, "contact_load": 0.1}


def healthy(seed):
    env = Solid(0.0, 1.0, 1.0)
    rows = [env.reset(seed=seed)[1]["stream"]]
    return np.stack(rows + [env.step(np.zeros(2))[4]["stream"] for _ in range(150)])


@pytest.mark.parametrize(
    ("family", "fault", "case"),
    [
        ("object", (19.0, 0.0, 0.0), "lasting contact"),
        ("object", (19.0, 0.0, 1.0), "object"),
        ("object", (19.0, 1.0, 0.0), "object"),
        ("object", (0.0, 0.0, 0.0), "object"),
        ("joint", (19.0, 0.0, 1.0), "lasting actuator"),
        ("joint", (19.0, 1.0, 0.0), "actuator"),
    ],
)
def test_nobody_goes_on_against_what_blocks_the_arm(family, fault, case, monkeypatch):
    monitor = Judge(range(60, 130, 5), family)
    streams = [healthy(seed) for seed in range(8)]
    monitor.spec = SOLID
    monitor.diagnosis_ = Diagnosis(
        Completion.fit(StreamScaler.fit(SOLID, streams), streams), Named(family)
    )
    joint = next(h for h in monitor.diagnosis_.hypotheses if h.part == "joint[1]")
    diagnosed = Diagnosis.__call__
    monkeypatch.setattr(
        Diagnosis, "__call__", lambda *given: diagnosed(*given)._replace(part=joint.part)
    )
    env = NeuralASMSafety(Solid(*fault), monitor, "graded", release_after=2)
    env.reset(seed=99)
    said = []
    while len(said) < 125 and not (said and said[-1]["gave_up"]):
        said.append(env.step(ACT)[4]["asm"])
    first = next((t for t, s in enumerate(said) if s["case"] == case), None)
    # not at once
    assert {s["case"] for s in said[60:80]} == {
        "",
        "actuator" if family == "joint" else family,
    }
    assert first is not None
    assert (first >= 60 + 25) == case.startswith("lasting")
    assert any(s["intervened"] for s in said) or not case.startswith("lasting")
    assert said[-1]["gave_up"] == (case == "lasting actuator")


@pytest.mark.parametrize("family", ["joint", "object", "contact", "sensor", "command"])
def test_what_presses_decides_whatever_the_cause_is_taken_for(family):
    class Pressing(Acting):
        @property
        def felt(self):
            return 1.2 if self.t == 10 else 0.1

    env = NeuralASMSafety(Pressing(), Judge({9}, family), release_after=2)
    said = infos(env, 12)
    assert (said[9]["case"], said[9]["response"], said[9]["reason"]) == (
        "pressing",
        DEFAULT["pressing"],
        "contact",
    )
    assert said[9]["cause"]["family"] == {"joint": "actuator", "command": "action"}.get(
        family, family
    )
    assert said[9]["severity"]["presses"]
    assert [s["intervened"] for s in said[8:12]] == [False, False, True, True]


def test_what_presses_is_an_alarm_though_nobody_is_surprised():
    class Pressing(Acting):
        @property
        def felt(self):
            return 1.2 if self.t == 10 else 0.1

    for on_alarm in ("graded", "hold", "monitor", "terminate"):
        env = NeuralASMSafety(Pressing(), Judge(()), on_alarm)
        env.reset(seed=0)
        outs = [env.step(ACT) for _ in range(10)]
        said = outs[-1][4]
        assert (said["asm"]["alarm"], said["asm"]["reason"], said["cost"]) == (True, "contact", 1.0)
        assert said["asm"]["surprise"] < said["asm"]["threshold"]
        assert outs[-1][2] == (on_alarm == "terminate")
        assert said["asm"]["state"] == ("reflex" if on_alarm in ("graded", "hold") else "policy")


def test_who_presses_for_the_third_time_is_ended_and_who_presses_for_long_is_too():
    class Often(Acting):
        @property
        def felt(self):
            return 1.2 if self.actions and np.array_equal(self.actions[-1], ACT) else 0.1

    env = NeuralASMSafety(Often(), Judge(()), release_after=2)
    env.reset(seed=0)
    ends = []
    while not ends or not ends[-1]:
        ends.append(env.step(ACT)[2])
    assert len(ends) == 1 + 2 * (2 + 1)  # pressed, held for two, and so again; the third ends it


@pytest.mark.parametrize(
    ("felt", "probability", "goes_on"),
    [(0.1, 0.9, True), (None, 0.9, False), (0.1, 0.45, False), (1.1, 0.9, False)],
)
def test_the_policy_goes_on_only_where_somebody_would_feel_and_the_cause_is_sure(
    felt, probability, goes_on
):
    monitor = Judge({10}, "object")
    named = monitor.diagnosis_.readout
    named.p = probability * (named.p == named.p.max()) + (1 - probability) * (
        named.p != named.p.max()
    ) / (len(named.p) - 1)
    inner = Acting()
    inner.felt = felt
    said = infos(NeuralASMSafety(inner, monitor, "graded"), 13)
    assert (said[10]["transition"] == "go on") == goes_on
    assert said[11]["intervened"] != goes_on


@pytest.mark.parametrize(("force", "goes_on"), [(39.0, True), (41.0, False)])
def test_the_policy_goes_on_in_alarm_only_while_it_presses_no_harder_than_free_motion(
    force, goes_on
):
    monitor = Judge({10}, "object")
    diagnosis, spec = monitor.diagnosis_, monitor.spec
    diagnostician = Diagnostician(spec, diagnosis, DEFAULT, responds=True)
    no, shares = np.zeros(spec.size, bool), np.full(spec.size, 1.0 / spec.size)
    rows = np.zeros((3, spec.size), np.float32)
    robot = RobotTable(1, spec, 1.0).robot(0)
    robot.over, robot.contact_force, robot.hand_speed = True, force, 0.1
    alarm = RowEvidence(
        index=0,
        robot=robot,
        rows=rows,
        attribution=shares,
        accounted_for=no,
        terms=(SURPRISE,),
        contradiction=None,
        completed=(),
        may_go_on=True,
    )
    assert diagnostician.prescribe(alarm).response.name == ("go on" if goes_on else "hold")


def test_the_policy_goes_on_for_a_bounded_time_and_is_held_then():
    env = NeuralASMSafety(Acting(), Judge(range(2, 150), "object"), "graded")
    env.reset(seed=0)
    said = []
    while len(said) < 119 and not (said and said[-1]["gave_up"]):
        said.append(env.step(ACT)[4]["asm"])
    assert [s["transition"] for s in said[2:102]] == ["go on"] * 100  # five seconds
    assert said[102]["transition"] == "override"


@pytest.mark.parametrize("response", ["go on", "complete"])
@pytest.mark.parametrize("cause", ["pressing", "lasting pressing"])
def test_a_table_that_lets_a_pressing_arm_go_on_is_refused(cause, response):
    with pytest.raises(
        ValueError, match=f"'{response}' would let a pressing arm go on: {cause} takes hold"
    ):
        NeuralASMSafety(Acting(), Judge(()), responses={cause: response})


def weighed(loads, speed=np.nan):
    """Force, impulse, and whether it presses, in rows (T,) of what a wrist bears along its axis [N]."""
    spec = StreamSpec((Channel("wrist_force", 3, "N"), Channel("hand_velocity", 3, "m/s")), 0.05)
    table = RobotTable(1, spec, 10.0)
    columns = contact_columns((), spec)
    most_impulse = GuardOptions().rule(True, 0.05, 1).impulse
    found = []
    for load in loads:
        row = np.array([[0.0, 0.0, load, 0.0, 0.0, speed]], np.float32)
        measure_contacts(table.records, row, no_load(1, 0), columns, spec.dt, most_impulse)
        robot = table.robot(0)
        found.append((robot.contact_force, robot.pressed_impulse, robot.presses))
    return np.array(found)


def test_the_weight_of_the_hand_is_no_contact_and_hides_none():
    found = weighed([-8.0] * 40 + [46.0] * 3)
    assert np.abs(found[1:40, 0]).max() < 1e-3
    assert found[-1, 0] == pytest.approx(54.0, abs=0.1)


def test_who_leans_again_and_again_presses_though_he_lets_go_for_a_moment():
    assert weighed([0.0] * 20 + [60.0, 60.0, 60.0, 0.0] * 6)[-4:, 2].any()
    assert not weighed([0.0] * 20 + [60.0, 0.0, 0.0, 0.0] * 6)[:, 2].any()


def test_who_leans_hard_with_a_slow_hand_presses_sooner_than_one_whose_own_inertia_that_may_be():
    slow, fast, gentle = (
        weighed([0.0] * 20 + [force] * 12, v)[20:, 2] for force, v in ((76, 0), (76, 0.3), (42, 0))
    )
    assert (np.argmax(slow), np.argmax(fast), np.argmax(gentle)) == (2, 10, 8)


def test_an_impulse_that_ends_the_episode_is_an_alarm():
    found = weighed([0.0, 6000.0])  # with what one row leaves of the time to lean
    assert found[-1, 1] > IMPULSE
    assert found[-1, 2]


def test_a_policy_that_turns_back_leaves_a_contact_while_the_guard_holds(lift):
    holds = {"pressing": "hold", "lasting pressing": "hold"}
    env = NeuralASMSafety(lift, responses=holds)
    env.reset(seed=0)
    down = np.float32([0, 0, -1, 0, 0, 0, -1])
    said = {}
    for _ in range(120):
        *_, info = env.step(down)
        said = info["asm"]
        if said["state"] == "reflex":
            break
    assert said["state"] == "reflex"
    simulation = lift.unwrapped.simulation
    site = simulation.arms.site[0]
    before = simulation.data.site_xpos[site][2]
    back = [env.step(-down)[-1] for _ in range(10)]
    assert any(
        info["asm"]["intervened"] and info["asm"]["executed_action"][2] > 0.0 for info in back
    )
    assert simulation.data.site_xpos[site][2] > before
    assert back[-1]["contact_force"] < 40.0
