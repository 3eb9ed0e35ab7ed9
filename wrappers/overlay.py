"""Pictures that show what the monitor thinks: a strip chart of surprise under every rendered frame."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.validation import check_number, short_repr
from asm_gym.wrappers.chart import StripChart, arrow, compose, project

ARROW_M = 0.01
"""Length of a force's arrow [m/N]."""

ARROW_S = 0.5
"""How long it is shown after the alarm that named the force [s]."""

SURE = 0.9
"""Least probability at which a cause is named."""

FELT = 1.0
"""Least force that a fault presses with for an arrow [N]."""


class SurpriseOverlay(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Draws surprise, threshold, alarm and ground-truth fault under the pictures of a watched environment.

    Goes over ``NeuralASMSafety``, and under ``RecordVideo``. Reads ``info["asm"]`` (surprise, threshold, alarm,
    intervened) and, where there is one, ``info["fault"]`` (truthy while a fault is active). Changes nothing but
    what ``render`` returns.

    Args:
        env: an environment with ``render_mode="rgb_array"``.
        caption: what to call the episode, such as the condition.
        seconds: time the chart shows [s].
        chart_height: [px]; a quarter of the picture where None.
        camera: of the pictures; where it is given, an arrow shows the force that a fault presses with, or else that
            the monitor takes a contact for, in environments of this package.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        caption: str = "",
        seconds: float = 5.0,
        chart_height: int | None = None,
        camera: str | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, caption=caption, seconds=seconds, chart_height=chart_height, camera=camera)
        gym.Wrapper.__init__(self, env)
        if env.render_mode != "rgb_array":
            raise ValueError(
                f'SurpriseOverlay draws on pictures and needs render_mode="rgb_array", got {env.render_mode!r}: '
                'make the environment with gym.make(..., render_mode="rgb_array")'
            )
        if not isinstance(caption, str):
            raise ValueError(f"caption must be a text, got {short_repr(caption)}")
        self.caption = caption
        self._seconds = check_number("seconds", seconds, above=0, high=3600)
        if chart_height is not None:
            check_number("chart_height", chart_height, low=1, high=4096, whole=True)
        self._chart_height, self._camera = chart_height, camera
        self._dt = _control_period(env)
        self._chart: StripChart | None = None  # made at the first picture, whose width it needs
        self._clear()

    def _clear(self) -> None:
        self._ratio: list[float] = []  # surprise / threshold, one a step
        self._alarm: list[bool] = []
        self._fault: list[bool] = []
        self._intervened = False
        self._cause = self._completed = ""  # named at the last alarm
        self._force: dict[str, Any] | None = None
        self._since_force = 0  # steps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._clear()
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        asm = info.get("asm")
        if asm is None:
            raise KeyError(
                'SurpriseOverlay found no info["asm"]: put it over NeuralASMSafety, '
                f"as in SurpriseOverlay(NeuralASMSafety(env, monitor)); it is over {self.env}"
            )
        surprise, threshold = float(asm["surprise"]), float(asm["threshold"])
        if not threshold > 0:
            raise ValueError(f"a log axis needs a threshold > 0, got {threshold}")
        self._ratio.append(surprise / threshold)
        self._alarm.append(bool(asm["alarm"]))
        self._fault.append(bool(info.get("fault")))
        self._intervened = bool(asm["intervened"])
        cause = asm.get("cause") or {}
        if cause.get("family"):
            sure = cause["family"] != "unknown" and cause["probability"] >= SURE
            self._cause = " ".join(filter(None, (cause["family"], cause["part"]))) if sure else ""
        self._since_force += 1
        if cause.get("force", {}).get("link"):
            self._force, self._since_force = cause["force"], 0
        completed = asm.get("completed") or ()
        self._completed = f"{', '.join(completed)} completed" if completed else ""
        return observation, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8]:
        """(H + chart height, W, 3) uint8."""
        frame = np.asarray(self.env.render())
        height, width = frame.shape[:2]
        frame = self._with_arrow(frame)
        if self._chart is None or self._chart.width != width:
            # In units of the threshold, the chart is the same whatever the monitor.
            steps = max(2, round(self._seconds / self._dt))
            self._chart = StripChart(width, self._chart_height or max(72, height // 4), steps)
        strip = self._chart.draw(self._ratio, self._alarm, self._fault)
        return compose(frame, strip, bool(self._alarm and self._alarm[-1]), self._line())

    def _with_arrow(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An arrow that ends where the arm is pressed: by a fault, or else by what the monitor named."""
        if self._camera is None:
            return frame
        from asm_gym.envs.robosuite_env import RobosuiteEnv  # charts need no robosuite

        inner = self.env.unwrapped
        if not isinstance(inner, RobosuiteEnv):
            return frame
        model, data = inner.simulation.model, inner.simulation.data
        pressed = int(np.argmax(np.linalg.norm(data.xfrc_applied[:, :3], axis=1)))
        force, where = data.xfrc_applied[pressed, :3], data.xipos[pressed]
        newtons = float(np.linalg.norm(force))
        if newtons < FELT:
            if self._force is None or self._since_force * self._dt >= ARROW_S:
                return frame
            force, where = np.asarray(self._force["vector"]), data.body(self._force["link"]).xpos
            newtons = self._force["newtons"]
        eye = model.camera(self._camera).id
        axes, size = data.cam_xmat[eye].reshape(3, 3), (frame.shape[0], frame.shape[1])
        ends = np.stack([where - ARROW_M * force, where])
        seen = project(ends, data.cam_xpos[eye], axes, float(model.cam_fovy[eye]), size)
        return arrow(frame, seen, f"{newtons:.0f} N")

    def _line(self) -> str:
        time = f"{len(self._ratio) * self._dt:.2f} s"
        acting = "override acting" if self._intervened else "policy acting"
        return "   ".join(part for part in (self.caption, time, acting, self._completed or self._cause) if part)


def _control_period(env: gym.Env[Any, Any]) -> float:
    """[s] from the stream's spec, or from the frame rate of environments that have no stream."""
    spec = getattr(env.unwrapped, "stream_spec", None)
    return float(spec.dt if spec is not None else 1.0 / env.metadata.get("render_fps", 20))
