"""Every monitor keeps one contract, and each baseline does what its source says."""

from functools import cache

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors import MONITORS, load_monitor, make_monitor
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.needs import needs
from tests.streams import sine_episodes

SPEC = StreamSpec(
    (
        Channel("external_torque_peak", 3, "N m", 0.1, "torque"),
        Channel("wrist_force_peak", 3, "N", 0.2, "wrench"),
        *(Channel(f"joint_{name}", 2, "rad", 0.02, "joint") for name in ("position", "velocity")),
        Channel("measured_torque", 2, "N m", 0.02, "torque"),
        Channel("command", 2, group=MOTOR),
    ),
    0.05,
    "arm",
)


TORCH = "asm_gym.monitors.baselines.torch_baselines"


def episodes(count, seed=0):
    return sine_episodes(count, seed, SPEC)


@cache
def fitted(name):
    """Once, with few updates, for the contract asks for no skill."""
    model = name.partition("+")[0]
    few = {"neural_asm": {"epochs": 4, "hidden_size": 16}, "logpzo": {"updates": 300}}
    with pytest.MonkeyPatch.context() as less:
        less.setattr(f"{TORCH}.EPOCHS", 100)
        return make_monitor(name, SPEC, **few.get(model, {}), seed=1).fit(episodes(20))


@pytest.fixture(scope="module", params=list(MONITORS))
def monitor(request):
    return fitted(request.param).calibrate(episodes(40, 1), 0.05)


def test_attribution_adds_up_and_scores_are_what_observing_gives(monitor):
    batch = episodes(3, seed=2)
    scores = monitor.score_episodes(batch)
    for episode, score in zip(batch, scores, strict=True):
        assert score.value.shape == (len(episode),)
        np.testing.assert_allclose(score.attribution.sum(axis=1), score.value)
        state, values = monitor.initial_state(1), []
        for row in episode.stream:
            state, surprise = monitor.observe(state, row[None])
            values.append(surprise.value[0])
        np.testing.assert_allclose(values, score.value, rtol=1e-4)


def test_the_calibrated_rate_is_kept(monitor):
    """At most 5 % of fresh nominal episodes on average; of 200, 24 or more would be a one in 10⁴ chance at 10 %."""
    alarms = sum(
        s.value.max() > monitor.threshold for s in monitor.score_episodes(episodes(200, seed=3))
    )
    assert alarms < 34


def test_what_is_not_finite_is_infinitely_surprising_there_alone(monitor):
    stream = episodes(1, seed=4)[0].stream.copy()
    stream[10, 4] = np.nan
    score = monitor.score(Episode.from_stream(stream, SPEC))
    assert np.isinf(score.value[10])
    assert np.flatnonzero(score.attribution[10]).tolist() == [4]
    assert np.isfinite(score.value[11:]).all()


def test_a_checkpoint_keeps_every_bit(monitor, tmp_path):
    monitor.save(tmp_path / "m.asm")
    loaded = load_monitor(tmp_path / "m.asm")
    assert type(loaded) is type(monitor)
    assert loaded.detection.name == monitor.detection.name
    episode = episodes(1, seed=5)[0]
    np.testing.assert_array_equal(loaded.score(episode).value, monitor.score(episode).value)
    assert (loaded.threshold, loaded.threshold_at(0.2)) == (
        monitor.threshold,
        monitor.threshold_at(0.2),
    )
    (tmp_path / "m.asm").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match=r"m\.asm"):
        load_monitor(tmp_path / "m.asm")


def test_bad_episodes_and_order_are_refused(monitor):
    new = make_monitor(monitor.model.kind, SPEC)
    with pytest.raises(RuntimeError, match="fit"):
        new.calibrate(episodes(2), 0.5)
    with pytest.raises(ValueError, match="at least one"):
        new.fit([])
    with pytest.raises(ValueError, match="joint_position"):
        new.fit(sine_episodes(1))
    broken = episodes(1)[0].stream.copy()
    broken[3, 1] = np.inf
    with pytest.raises(ValueError, match=r"episode 0, step 3, external_torque_peak\[1\]"):
        new.fit([Episode.from_stream(broken, SPEC)])
    with pytest.raises(ValueError, match="at least 19"):
        monitor.calibrate(episodes(3, seed=1), 0.05)
    with pytest.raises(ValueError, match="numbers a step"):
        monitor.observe(monitor.initial_state(1), np.zeros((1, 3)))


def test_unknown_names_and_hyperparameters_list_the_known():
    with pytest.raises(ValueError, match=r"'oracle'.*neural_asm, logpzo"):
        make_monitor("oracle", SPEC)
    with pytest.raises(ValueError, match=r"'hiden_size'.*did you mean 'hidden_size'"):
        make_monitor("neural_asm", SPEC, hiden_size=3)


def test_training_slows_down_at_plateaus_ends_where_nothing_is_gained_and_keeps_the_best():
    torch = needs("torch")
    from asm_gym.monitors.baselines.torch_baselines import PATIENCE, train_on_episodes

    module, fresh = torch.nn.Linear(1, 1, bias=False), iter([5.0, 3.0, *[4.0] * 200])
    weights = []

    def loss(chosen, training):
        if training:
            return module.weight.sum()
        weights.append(float(module.weight.detach()))
        return torch.tensor(next(fresh))

    train_on_episodes(module, loss, 1, np.random.default_rng(0), lambda done, total: None)
    assert float(module.weight.detach()) == weights[1]
    assert len(weights) == 2 + 3 * (PATIENCE + 1)
    steps = -np.diff(weights)
    np.testing.assert_allclose([steps[0], steps[-1]], [1e-3, 9e-5], rtol=0.01)
