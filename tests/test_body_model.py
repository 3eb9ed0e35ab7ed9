"""Torques by a body model: against the unpared file and closed forms; and what a memory makes of them."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pandas as pd
import pytest

from asm_gym.data.episode import Episode
from asm_gym.data.training_selection import pieces
from asm_gym.monitors import NeuralASM, load_monitor, make_monitor
from asm_gym.monitors.torque.body_model import BodyModel, JointMotion
from asm_gym.monitors.torque.urdf import read_urdf
from asm_gym.monitors.torque.value_association import ValueAssociation
from asm_gym.scripts.cli import main


def link(name: str, mass: float, centre: str, inertia: tuple[float, ...]) -> str:
    tensor = " ".join(
        f'i{ij}="{v}"' for ij, v in zip(("xx", "yy", "zz", "xy", "xz", "yz"), inertia, strict=True)
    )
    return (
        f'<link name="{name}"><visual><geometry><box size="1 1 1"/></geometry></visual><inertial>'
        f'<origin xyz="{centre}"/><mass value="{mass}"/><inertia {tensor}/></inertial></link>'
    )


def joint(name: str, kind: str, parent: str, child: str, origin: str, axis: str) -> str:
    limit = (
        ""
        if kind in ("fixed", "continuous")
        else '<limit lower="-3" upper="3" effort="99" velocity="9"/>'
    )
    return (
        f'<joint name="{name}" type="{kind}"><origin {origin}/><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
    )


def arm() -> str:
    """A lift that slides, a shoulder, an elbow askew and a tool that is fixed to it; a head beside them."""
    return "".join(
        (
            '<robot name="arm"><link name="base"/>',
            link("torso", 4.0, "0.01 0 0.2", (0.2, 0.21, 0.1, 0.0, 0.01, 0.0)),
            link("upper", 3.0, "0.1 0.02 -0.01", (0.02, 0.05, 0.05, 0.001, 0.0, 0.002)),
            link("lower", 2.0, "0.15 0 0.03", (0.01, 0.03, 0.03, 0.0, 0.001, 0.0)),
            link("tool", 0.7, "0 0 0.05", (0.001, 0.0015, 0.002, 0.0, 0.0, 0.0)),
            link("head", 1.0, "0 0.1 0", (0.01, 0.01, 0.01, 0.0, 0.0, 0.0)),
            joint("lift", "prismatic", "base", "torso", 'xyz="0 0 0.5" rpy="0.1 0.2 0"', "0 0 1"),
            joint("look", "revolute", "torso", "head", 'xyz="0 0 0.6"', "0 0 1"),
            joint(
                "shoulder", "revolute", "torso", "upper", 'xyz="0.1 0 0.4" rpy="1.2 0 0.3"', "0 1 0"
            ),
            joint(
                "elbow", "continuous", "upper", "lower", 'xyz="0.3 0 0" rpy="0 0.4 0"', "0 0.6 0.8"
            ),
            joint("grip", "fixed", "lower", "tool", 'xyz="0.3 0 0.1" rpy="0 0 0.5"', "1 0 0"),
            "</robot>",
        )
    )


SENSED = ("position[elbow]", "position[lift]", "position[shoulder]")


def test_torques_are_those_of_mujoco():
    body = BodyModel.of(arm(), SENSED)
    apart = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'  # fused, it puts the tool elsewhere
    model = mujoco.MjModel.from_xml_string(arm().replace("</robot>", apart))
    data = mujoco.MjData(model)
    told = np.random.default_rng(0).uniform(-1, 1, (3, 6, 3))
    found = np.add(*body.torques(JointMotion(*told)))
    for n in range(6):
        for k, name in enumerate(("elbow", "lift", "shoulder")):
            there = model.joint(name)
            data.qpos[there.qposadr], data.qvel[there.dofadr], data.qacc[there.dofadr] = told[
                :, n, k
            ]
        mujoco.mj_inverse(model, data)
        expected = [
            data.qfrc_inverse[model.joint(name).dofadr[0]] for name in ("elbow", "lift", "shoulder")
        ]
        np.testing.assert_allclose(found[n], expected, rtol=1e-9, atol=1e-9)


def test_a_pendulum_weighs_what_a_pendulum_weighs():
    urdf = (
        '<robot name="p"><link name="base"/><link name="bob"><inertial><origin xyz="0.5 0 0" '
        'rpy="1.5707963267948966 0 0"/>'
        '<mass value="2"/><inertia ixx="7" ixy="0" ixz="0" iyy="7" iyz="0" izz="0.1"/></inertial></link>'
        '<joint name="j" type="continuous"><parent link="base"/><child link="bob"/><axis xyz="0 -1 0"/></joint></robot>'
    )
    q = np.linspace(-3, 3, 9)[:, None]  # about y, which is the inertia's z
    weight, motion = BodyModel.of(urdf, ["q"]).torques(
        JointMotion(q, np.ones_like(q), np.full_like(q, 3.0))
    )
    np.testing.assert_allclose(weight, 2 * 9.81 * 0.5 * np.cos(q), atol=1e-9)
    np.testing.assert_allclose(motion, (0.1 + 2 * 0.5**2) * 3.0, atol=1e-9)


def test_joints_are_those_that_columns_name_or_the_longest_chain():
    assert BodyModel.of(arm(), SENSED).columns.tolist() == [1, 2, 0]
    by_order = BodyModel.of(arm(), ["q[0]", "q[1]", "q[2]"])
    assert (by_order.names, by_order.columns.tolist()) == (("lift", "shoulder", "elbow"), [0, 1, 2])
    assert not by_order.by_name
    in_part = BodyModel.of(arm(), ["q.elb.elbow_left", "q[lift]", "q[finger]", "q.the_shoulder"])
    assert (in_part.by_name, in_part.columns.tolist()) == (True, [1, 3, 0])
    tip = re.findall('link name="([^"]*)"', arm())[-1]
    finger = f'<link name="tip"/><joint name="panda_finger_joint1" type="prismatic"><parent link="{tip}"/>'
    finger += '<child link="tip"/><axis xyz="1 0 0"/></joint></robot>'
    numbered = arm().replace('"lift"', '"panda_joint1"').replace('"shoulder"', '"panda_joint2"')
    numbered = numbered.replace("</robot>", finger)
    numbered = numbered.replace('"elbow"', '"panda_joint3"')
    labels = ["position[fer_joint3]", "position[fer_joint1]", "position[fer_joint2]"]
    assert BodyModel.of(numbered, labels).columns.tolist() == [1, 2, 0]


def test_several_roots_stand_side_by_side():
    more = arm().replace("</robot>", '<link name="camera"/></robot>')
    told = np.random.default_rng(0).uniform(-1, 1, (3, 6, 3))
    for one, other in zip(
        BodyModel.of(arm(), SENSED).torques(JointMotion(*told)),
        BodyModel.of(more, SENSED).torques(JointMotion(*told)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_unnamed_joints_are_taken_in_the_order_that_explains_the_torques(order):
    columns = recorded(20)
    q, v, torque = (columns[name][:, order] for name in ("position", "velocity", "effort"))
    body = BodyModel.of(arm(), ["q[0]", "q[1]", "q[2]"]).in_best_order(
        JointMotion(q, v, np.gradient(v, 0.01, axis=0)), torque
    )
    assert [order[k] for k in body.columns] == [0, 1, 2]


@pytest.mark.parametrize("case", ["named", "unnamed", "without masses"])
def test_a_body_model_is_used_where_it_explains_unseen_torques_and_pushes_are_found_in_any_order(
    case,
):
    names, order = ("lift", "shoulder", "elbow"), [2, 0, 1]
    named = "[{}]" if case == "named" else "_{}"
    columns = recorded(30)
    table = {"time": columns.pop("time")} | {
        f"{kind}{named.format(names[j] if case == 'named' else k)}": values[:, j]
        for kind, values in columns.items()
        for k, j in enumerate(order)
    }
    cut = pieces(Episode.from_table(table), 1.0)
    urdf = re.sub("<inertial>.*?</inertial>", "", arm()) if case == "without masses" else arm()
    found = {}
    for body in ("", urdf):
        monitor = (
            make_monitor("association_values+largest", cut[0].spec, urdf=body)
            .fit(cut[:20])
            .calibrate(cut[20:], 0.1)
        )
        stream = cut[25].stream.copy()
        stream[50:, -1] += 1.5
        found[body] = (
            monitor.score(Episode.from_stream(stream, cut[0].spec)).value.max() / monitor.threshold
        )
    model = monitor.model
    assert isinstance(model, ValueAssociation)
    if case == "without masses":
        assert model.left_by_body == pytest.approx(1.0)
        assert (model.body, found[urdf]) == (None, found[""])
    else:
        assert model.left_by_body < 0.5
        assert [joint for _, joint in model.joints] == [names[j] for j in order]
        assert found[urdf] > max(1.0, found[""])


def test_joints_that_nobody_senses_and_joints_that_mimic_are_fixed_and_links_without_mass_weigh_nothing():
    carried = BodyModel.of(arm(), SENSED[1:2]).torques(JointMotion(*np.zeros((3, 1, 1))))[0].item()
    up = np.cos(0.1) * np.cos(0.2)  # of the lift's axis
    assert carried == pytest.approx((4 + 3 + 2 + 0.7 + 1) * 9.81 * up)
    mimic = arm().replace(
        '<axis xyz="0 0.6 0.8"/>', '<axis xyz="0 0.6 0.8"/><mimic joint="shoulder"/>'
    )
    assert BodyModel.of(mimic, SENSED[1:]).names == ("lift", "shoulder")
    massless = re.sub("<inertial>.*?</inertial>", "", arm())
    np.testing.assert_allclose(
        BodyModel.of(massless, SENSED).torques(JointMotion(*np.ones((3, 1, 3)))), 0.0, atol=1e-9
    )


@pytest.mark.parametrize(
    ("urdf", "said"),
    [
        ("position", "the body is no URDF: syntax error"),
        ("<mujoco/>", "its root is <mujoco>, not <robot>"),
        ('<!DOCTYPE r [<!ENTITY a "aa">]><robot/>', "declares a document type"),
        ("<robot/>", "3 joints are sensed, and .* 0 that move"),
        (arm().replace('child link="tool"', 'child link="base"'), "the body cannot be read"),
        (arm().replace('child link="tool"', 'child link="gone"'), "the body cannot be read"),
        (arm().replace('xyz="0 0.6 0.8"', 'xyz="0 0 0"'), "cannot be read: .*axis"),
        (arm().replace('value="3.0"', 'value="nan"'), "the body cannot be read: .*mass"),
        (arm().replace('<parent link="base"/>', ""), "the body cannot be read: .*parent"),
        (
            arm().replace('"elbow" type="continuous"', '"elbow" type="fixed"'),
            r"3 joints are sensed, and .* 2 that move: .*\(lift, look, shoulder\)",
        ),
    ],
)
def test_what_is_no_body_of_the_arm_is_refused_in_a_line(urdf, said):
    with pytest.raises(ValueError, match=said) as refused:
        BodyModel.of(urdf, ["q[0]", "q[1]", "q[2]"])
    assert "\n" not in str(refused.value)


def recorded(seconds: float, seed: int = 0, rate: float = 100.0) -> dict[str, np.ndarray]:
    """The arm, as it moves by its own model, with friction and noise."""
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * rate)) / rate
    w = rng.uniform(0.5, 2.5, size=(2, 3))
    phase = rng.uniform(0, 6, size=(2, 3))
    size = np.array([0.15, 0.8, 1.2])
    q = sum(size * np.sin(np.outer(t, w[k]) + phase[k]) for k in range(2))
    v = sum(size * w[k] * np.cos(np.outer(t, w[k]) + phase[k]) for k in range(2))
    a = -sum(size * w[k] ** 2 * np.sin(np.outer(t, w[k]) + phase[k]) for k in range(2))
    load = np.add(*BodyModel.of(arm(), ["q"] * 3).torques(JointMotion(q, v, a)))
    said = {"position": q, "velocity": v, "effort": load + 0.5 * np.tanh(v / 0.02) + 0.2 * v}
    return {"time": t} | {
        n: x + s * rng.normal(size=q.shape) for (n, x), s in zip(said.items(), NOISE, strict=True)
    }


NOISE = (1e-4, 1e-3, 0.05)


def test_a_memory_expects_torques_by_it_and_needs_the_file_no_more(tmp_path):
    (tmp_path / "arm.urdf").write_text(arm())
    urdf = read_urdf(tmp_path / "arm.urdf")
    assert "visual" not in urdf
    cut = pieces(Episode.from_table(recorded(30)), 1.0)
    told = {}
    for model in ("", urdf):
        monitor = make_monitor("association_values+evidence", cut[0].spec, urdf=model).fit(cut)
        told[model] = 1 - monitor.learned_["R2_values"][6:]
    assert (told[urdf] < 0.5 * told[""]).all()
    asm = NeuralASM(
        cut[0].spec, hidden_size=8, association_size=16, epochs=1, values=True, urdf=urdf
    )
    asm.fit(cut[:20]).calibrate(cut[20:], 0.1).save(tmp_path / "x.asm")
    assert isinstance(asm.values_.monitor.model, ValueAssociation)
    assert asm.values_.monitor.model.body is not None
    (tmp_path / "arm.urdf").unlink()
    again = load_monitor(tmp_path / "x.asm")
    np.testing.assert_array_equal(again.score(cut[25]).value, asm.score(cut[25]).value)
    with pytest.raises(ValueError, match="values are not judged"):
        NeuralASM(cut[0].spec, values=False, urdf=urdf)
    bare = Episode.from_table({"position": np.zeros((9, 3)), "velocity": np.zeros(9)}, rate=10.0)
    with pytest.raises(ValueError, match="by their names 3 numbers are angles and 1 are speeds"):
        NeuralASM(bare.spec, values=True, urdf=urdf)


def test_fit_takes_a_body_model_and_says_which_joints_it_saw(tmp_path, capsys):
    columns = {
        f"{n}_{k}": v
        for n, c in recorded(60).items()
        for k, v in enumerate(c.T if c.ndim > 1 else [c])
    }
    # of a gripper that tells no speed
    columns["finger_position"] = 0.02 * np.sin(3 * columns["time_0"])
    pd.DataFrame(columns).rename(columns={"time_0": "time"}).to_csv(
        tmp_path / "log.csv", index=False
    )
    (tmp_path / "arm.urdf").write_text(arm())
    command = [
        "fit",
        str(tmp_path / "log.csv"),
        "--out",
        str(tmp_path / "x.asm"),
        "--split",
        "1",
        "--quick",
    ]
    command += ["--urdf", str(tmp_path / "arm.urdf")]
    command += ["--monitor", "association_values+evidence", "--false-alarm-rate", "0.1"]
    assert main(command) == 2
    assert (
        "4 numbers are angles and 3 are speeds; leave out others, as --ignore '*finger*'"
        in capsys.readouterr().err
    )
    assert main([*command, "--ignore", "*finger*"]) == 0
    said = capsys.readouterr().out
    assert "position[0] for lift, position[1] for shoulder, position[2] for elbow" in said
    estimate = re.search(r"([\d.]+) an hour, at most ([\d.]+) with 95 % confidence", said)
    assert estimate is not None
    assert 0 < float(estimate[1]) < float(estimate[2])
    assert load_monitor(tmp_path / "x.asm").get_params()["urdf"].startswith("<robot")
    weightless = re.sub("<inertial>.*?</inertial>", "", arm())
    (tmp_path / "arm.urdf").write_text(weightless)
    assert main([*command, "--ignore", "*finger*"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "arm.urdf is not used" in said
    assert "position[0] for lift, position[1] for shoulder, position[2] for elbow" in said
    assert main([*command, "--monitor", "kalman"]) == 2
    assert capsys.readouterr().err.strip().endswith("kalman takes no body model: leave --urdf out")
    (tmp_path / "arm.urdf").write_text("<robot")
    assert main([*command, "--monitor", "association_values+evidence"]) == 2
    assert "arm.urdf: the body is no URDF" in capsys.readouterr().err
