"""A memory as an ONNX graph says what ``observe`` says, row by row, and never passes what is not finite."""

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.monitors import NeuralASM
from asm_gym.monitors.onnx_export import STATE, initial_state, write_onnx
from tests.needs import needs
from tests.streams import sine_episodes, sine_spec

needs("onnx")
runtime = needs("onnxruntime")


def said(asm, path, streams):
    """Value and attribution of each row of (T, B, D), by the graph and by the memory."""
    session, carried = runtime.InferenceSession(str(path)), initial_state(asm, streams.shape[1])
    state, found = asm.initial_state(streams.shape[1]), []
    for rows in streams.astype(np.float64):
        value, attribution, *new = session.run(None, {"row": rows, **carried})
        carried = dict(zip(STATE, new, strict=True))
        state, surprise = asm.observe(state, rows)
        found.append((value, surprise.value, attribution, surprise.attribution))
    return [np.array(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("habituates", [True, False])
@pytest.mark.parametrize("dt", [0.05, 0.01])  # every row, and every fifth
def test_the_graph_says_what_the_memory_says(tmp_path, dt, habituates):
    spec = replace(sine_spec(), dt=dt)
    asm = NeuralASM(spec, 8, 12, epochs=2, habituates=habituates).fit(sine_episodes(30, 0, spec))
    streams = np.stack([e.stream[:40] for e in sine_episodes(3, 1, spec)], axis=1)
    streams[30:, 1, 0] += 2.0  # one is off
    streams[30:, 2, 0] = streams[30, 2, 0]  # and one is stuck
    graph, memory, shares, own = said(asm, write_onnx(asm, tmp_path / "x.onnx"), streams)
    assert memory[30:, 1:].max() > 2 * memory[:30].max()
    np.testing.assert_allclose(graph, memory, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(shares, own, rtol=1e-2, atol=1e-4)


def test_what_is_not_finite_is_infinitely_surprising_from_then_on(tmp_path):
    asm = NeuralASM(sine_spec(), 8, 12, epochs=1).fit(sine_episodes(20))
    streams = np.stack([e.stream for e in sine_episodes(1, 1)], axis=1)
    streams[10, 0, 0] = np.nan
    graph, _, shares, own = said(asm, write_onnx(asm, tmp_path / "x.onnx"), streams)
    assert np.isfinite(graph[:10]).all()
    assert np.isinf(graph[10:]).all()
    np.testing.assert_array_equal(shares[10], own[10])


def test_what_cannot_be_a_graph_is_refused(tmp_path):
    asm = NeuralASM(sine_spec(), 8, 12, epochs=1, dynamics="settling").fit(sine_episodes(20))
    with pytest.raises(ValueError, match="got 'settling'"):
        write_onnx(asm, tmp_path / "x.onnx")
