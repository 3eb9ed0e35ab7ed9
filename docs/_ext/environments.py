"""A page for each environment, written anew with a build: a picture, what is observed, acted and rewarded.

All of it is read off the environment itself. The picture is taken where the scripted expert has solved the task; it is
kept until the environments' code changes, and left out where nothing can draw.
"""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
from sphinx.application import Sphinx
from sphinx.util import logging

from asm_gym.envs import rewards
from asm_gym.graphics import rendering_problem
from asm_gym.policies import make_policy
from asm_gym.tasks import TASKS, TaskSpec

SIZE = (360, 480)
EXPERTS = "results/archive/experts.md"
SENSED = {
    "joint_position": "angle of each joint",
    "joint_velocity": "its rate",
    "hand_position": "x, y, z of the hand, in the world",
    "hand_orientation": "first two columns of the hand's rotation",
    "gripper_opening": "of each finger",
    "gripper_velocity": "its rate",
}
# Of objects: how a name ends, what its unit is, and what it is. The first that fits.
OBJECTS = (
    ("_quat", "1", "orientation, a quaternion (x, y, z, w)"),
    ("_qpos", "rad", "angle of the hinge"),
    ("_id", "1", "which of the objects is in play"),
    ("radius", "m", "mean distance of what is dirty from its centroid"),
    ("centroid", "m", "x, y, z"),
    ("angle", "1", "cosine of the angle between peg and hole"),
    ("t", "m", "distance of the hole along the peg"),
    ("d", "m", "distance of the hole from the peg's axis"),
    ("pos", "m", "x, y, z"),
)
SHARES = ("proportion_wiped", "frame_is_assembled", "tool_on_frame", "payload_in_target_bin", "trash_in_trash_bin")


def table(headings: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """In Markdown."""
    head = tuple(headings)
    lines = (head, ("---",) * len(head), *rows)
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def of_object(name: str) -> tuple[str, str]:
    """Unit and meaning of a channel of the task's objects."""
    if name in SHARES:
        return "1", "0 or 1" if name != SHARES[0] else "0 to 1"
    if "_to_" in name and not name.endswith("_quat"):
        return "m", "x, y, z from the one to the other"
    found = (o for o in OBJECTS if name == o[0] or (len(o[0]) > 1 and name.endswith(o[0])))
    return next(((unit, what) for _, unit, what in found), ("1", ""))


def observations(env: Any) -> str:
    """A row for each channel, in the order of the flat observation."""
    channels = {c.name: c for c in env.measured_spec.channels}
    rows, at = [], 0
    for name, size in env.observation_layout.items():
        plain = re.sub(r"^robot\d_", "", name)
        unit, what = (channels[name].unit, SENSED[plain]) if plain in SENSED else of_object(name)
        numbers = f"{at} to {at + size - 1}" if size > 1 else str(at)
        noise = f"{channels[name].noise:g}" if channels[name].noise else ""
        rows.append((numbers, f"`{name}`", what, unit, noise))
        at += size
    return table(("number", "channel", "what", "unit", "noise"), rows)


def actions(env: Any) -> str:
    """A row for each part of the action under the default controller."""
    rows, start = [], 0
    robots = env.robosuite_env.robots
    for which, robot in enumerate(robots):
        arm = f" {which}" if len(robots) > 1 else ""
        for part, (low, high) in robot._action_split_indexes.items():
            if low == high:
                continue
            if "gripper" in part:
                rows.append((start + low, f"gripper{arm}", "-1 opens, 1 closes", ""))
                continue
            most = robot.part_controllers[part].output_max
            for at, what, unit in ((0, "moves along", "m"), (3, "turns about", "rad")):
                numbers = f"{start + low + at} to {start + low + at + 2}"
                rows.append((numbers, f"hand{arm}", f"{what} x, y, z of the base", f"±{most[at]:g} {unit} a step"))
        start += robot.action_dim
    return table(("number", "of", "what", "at ±1"), rows)


def reward(task: TaskSpec, terms: Iterable[str]) -> str:
    """What its own class says of the reward, and the names of its terms."""
    family = next(f for f in rewards._FAMILIES if task.name.startswith(f.__name__))
    module = inspect.getmodule(family)
    # What a family of tasks shares is said once, for its module.
    said = (inspect.getdoc(module) if "sorting" in family.__module__ else inspect.getdoc(family)) or ""
    said = " ".join(said.partition("\n\n")[2 if "sorting" in family.__module__ else 0].split())
    lines = [re.sub(r"``", "`", said), f'Terms in `info["reward_terms"]`: {", ".join(f"`{t}`" for t in terms)}.']
    if family is not rewards.Wipe:
        lines.append("They are scaled so that a step's reward is 1 at most.")
    if len(tuple(terms)) > 1:
        lines.append("With `reward_shaping=False` a step is worth 1 where the task is solved.")
    return "\n\n".join(lines)


def experts(page: Path) -> dict[str, str]:
    """Task to how many of 100 seeds its expert solved, as the page of results has it."""
    found: dict[str, str] = {}
    for names, numbers in re.findall(r"\| ([A-Z][\w, ;()]*?) \| ([\d, ;]+) (?=\|)", page.read_text(encoding="utf-8")):
        names = re.sub(r" \([\w ]+\)", "", names)
        family = re.match(r"(PickPlace|NutAssembly)?", names)[0]  # type: ignore[index]
        for name, number in zip(re.split("[,;] ", names), re.split("[,;] ", numbers), strict=True):
            found[name if name in TASKS else family + name] = number
    return found


def picture(task: TaskSpec, path: Path) -> None:
    """Of the task, solved by its expert where it solves this one."""
    from PIL import Image

    with gym.make(task.id, render_mode="rgb_array", render_size=SIZE, camera="frontview") as env:
        policy = make_policy("scripted", env, seed=0)
        observation, _ = env.reset(seed=0)
        state, done, solved = None, False, False
        while not (done or solved):
            action, state = policy.predict(observation, state)
            observation, _, terminated, truncated, info = env.step(action)
            done, solved = terminated or truncated, bool(info["success"])
        Image.fromarray(env.render()).save(path, quality=80)


def page(task: TaskSpec, solved: dict[str, str], drawn: bool) -> str:
    """The page of one task, in Markdown."""
    with gym.make(task.id) as made:
        env: Any = made.unwrapped
        env.reset(seed=0)
        terms = tuple(env.step(env.action_space.sample() * 0)[-1]["reward_terms"])
        size, act = sum(env.observation_layout.values()), env.action_space.shape[0]
        observed, acted = observations(env), actions(env)
    two = ' Two Pandas by default: `robot=("Panda", "UR5e")` names others.' if task.arms == 2 else ""
    reached = f"The scripted expert solved {solved[task.name]} of 100 seeds with the Panda ([command](../{EXPERTS}))."
    parts = [
        f"# {task.name}",
        f"Solved where {task.success}.",
        f"![{task.name}, where its scripted expert has got to](img/{task.name}.jpg)" if drawn else "",
        table(
            ("", ""),
            (
                ("make", f'`gym.make("{task.id}")`'),
                ("observation", f'`Box(-100, 100, ({size},), float32)`; `observation="dict"` for a channel by name'),
                ("action", f"`Box(-1, 1, ({act},), float32)`"),
                ("episode", f"{task.horizon} steps at 20 Hz, {task.horizon / 20:g} s; then it is truncated"),
            ),
        ),
        two.strip(),
        "## Observation",
        observed,
        "Noise is the standard deviation. [The stream](../reference/environments.md#the-stream) has more channels: "
        "torques, forces, and the action.",
        "## Action",
        "Of `OSC_POSE`, the default controller. Others: `controller=…`.",
        acted,
        "## Reward",
        reward(task, terms),
        "## What is reached",
        reached,
        f'`make_policy("scripted", env)` makes that expert, and `collect("{task.id}", policy="scripted", episodes=60)` '
        "records it.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def index(drawn: bool) -> str:
    """All tasks in a table, with their pictures."""
    rows = []
    for task in TASKS.values():
        small = f"![{task.name}](img/{task.name}.jpg)" if drawn else ""
        rows.append((small, f"[{task.name}]({task.name}.md)", task.success, task.arms, task.horizon))
    listed = "\n".join(TASKS)
    return (
        "# Environments\n\nEach is a Gymnasium environment, with exact seeds. [Arguments, episodes and the stream]"
        "(../reference/environments.md) are the same in all.\n\n"
        f"{table(('', 'task', 'solved where', 'arms', 'steps'), rows)}\n\n"
        f"```{{toctree}}\n:hidden:\n\n{listed}\n```\n"
    )


def digest(root: Path) -> str:
    """Of the code that the pages are made from."""
    files = [*root.glob("asm_gym/envs/**/*.py"), *root.glob("policies/scripted/*.py"), root / "asm_gym" / "tasks.py"]
    made = hashlib.sha256(Path(__file__).read_bytes() + (root / "docs" / EXPERTS).read_bytes())
    for path in sorted(files):
        made.update(path.read_bytes())
    return made.hexdigest()


def write(folder: Path, root: Path) -> None:
    """The pages and their pictures, unless they are there and nothing that they are made from has changed."""
    stamp, now = folder / ".made", digest(root)
    if stamp.exists() and stamp.read_text() == now:
        return
    (folder / "img").mkdir(parents=True, exist_ok=True)
    drawn = not rendering_problem()
    solved = experts(root / "docs" / EXPERTS)
    for task in TASKS.values():
        logging.getLogger(__name__).info("environment %s", task.name)
        if drawn:
            picture(task, folder / "img" / f"{task.name}.jpg")
        (folder / f"{task.name}.md").write_text(page(task, solved, drawn), encoding="utf-8")
    (folder / "index.md").write_text(index(drawn), encoding="utf-8")
    stamp.write_text(now)


def setup(app: Sphinx) -> dict[str, bool]:
    source = Path(app.srcdir)
    app.connect("builder-inited", lambda app: write(source / "environments", source.parent))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
