"""A memory as an ONNX graph: one row of each stream in, its surprise and the next state out.

    row (B, D), state → value (B,), attribution (B, D), next_state

The graph is the step of ``asm_gym.monitors.fused``, operator by operator, for runtimes that have no Python: what is
learned is inside, and the state is passed in and out by name. Skills are not named in it, and what a memory excuses or
hears of skills beside is not part of it. Rows should be finite: of one that is not the value is infinite, and so are
those that follow, until the state is begun anew.

``write_onnx(NeuralASM.pretrained("panda"), "panda.onnx")`` writes one. In onnxruntime ``session.run`` is given ``row``
and the arrays of a state by their names; ``initial_state(asm)`` has the first.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.evidence import CONTEXT_GAIN, POWER, TINY
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.extras import require
from asm_gym.memory.network import Network
from asm_gym.memory.state import UNSURE
from asm_gym.memory.traces import DECAYS
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.scaling import FARTHEST

STATE = ("traces", "expected", "before", "earlier", "steps", "vector", "lately", "counted", "said", "again", "unlikely")
"""What is carried from row to row; the new one comes out as ``next_`` and the name."""

OPSET = 17


def initial_state(asm: NeuralASM, batch: int = 1) -> dict[str, NDArray[Any]]:
    """Before the first row, by the names that the graph takes."""
    state = asm.initial_state(batch)
    return dict(zip(STATE, (*state.model[:5], *state.detection.evidence, *state.detection.repetition), strict=True))


def write_onnx(asm: NeuralASM, path: str | Path) -> Path:
    """Writes the graph of a fitted memory; its labels, period and threshold stand in the metadata.

    Raises:
        ValueError: the memory is none of traces judged by evidence, or judges values too.
        ImportError: onnx is not installed.
    """
    onnx = require("onnx", what="write_onnx")
    model, detection = asm.model, asm.detection
    if not isinstance(model.network, Network) or detection.name != "evidence":
        raise ValueError(
            f"an ONNX graph is of dynamics='traces' under evidence, got {asm.dynamics!r}, {detection.name!r}"
        )
    if asm.values_.monitor is not None:
        raise ValueError("an ONNX graph judges changes alone, and this memory values too: fit one with values=False")
    made = _Graph(onnx)
    _step(made, model, detection)
    first = {"row": np.zeros((1, asm.spec.size)), **initial_state(asm)}
    ends = ["value", "attribution", *(f"next_{name}" for name in STATE)]
    shapes = {"value": np.zeros(1), "attribution": first["row"], **{f"next_{n}": first[n] for n in STATE}}

    def described(name: str, like: NDArray[Any]) -> Any:
        kind = onnx.helper.np_dtype_to_tensor_dtype(like.dtype)
        return onnx.helper.make_tensor_value_info(name, kind, ["streams", *like.shape[1:]])

    inputs, outputs = [described(n, a) for n, a in first.items()], [described(n, shapes[n]) for n in ends]
    graph = onnx.helper.make_graph(made.nodes, "asm", inputs, outputs, made.constants)
    whole = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=9)
    about = {"labels": json.dumps(asm.spec.labels), "dt": repr(asm.spec.dt), "threshold": repr(asm.threshold_)}
    onnx.helper.set_model_props(whole, about)
    onnx.checker.check_model(whole)
    Path(path).write_bytes(whole.SerializeToString())
    return Path(path)


class _Graph:
    """Nodes and constants in the making; what stands between is known by its name."""

    def __init__(self, onnx: Any) -> None:
        self._onnx, self.nodes, self.constants = onnx, list[Any](), list[Any]()

    def __call__(self, kind: str, *inputs: Any, out: str = "", **attributes: Any) -> str:
        """A node of these inputs, names or arrays; the name of what comes out."""
        names = [x if isinstance(x, str) else self._kept(np.asarray(x)) for x in inputs]
        out = out or f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(kind, names, [out], **attributes))
        return out

    def _kept(self, array: NDArray[Any]) -> str:
        self.constants.append(self._onnx.numpy_helper.from_array(array, f"c{len(self.constants)}"))
        return str(self.constants[-1].name)

    def cast(self, what: str, kind: type[Any]) -> str:
        """The same as another type of number."""
        return self("Cast", what, to=self._onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind)))

    def taken(self, what: str, where: NDArray[np.intp]) -> str:
        """Some columns."""
        return self("Gather", what, np.asarray(where, np.int64), axis=1)

    def column(self, what: str) -> str:
        """(B,) as (B, 1)."""
        return self("Unsqueeze", what, np.array([1]))

    def summed(self, what: str, *axes: int) -> str:
        """The sum over some axes."""
        return self("ReduceSum", what, np.array(axes), keepdims=0)


def _step(g: _Graph, model: Any, detection: Any) -> None:
    """``asm_gym.monitors.fused._observe``, whose comments say what is what."""
    lag = model.lag
    due = g.column(g("Equal", g("Mod", "steps", np.int64(lag)), np.int64(0)))
    moved = g.column(g("GreaterOrEqual", "steps", np.int64(lag)))
    last = g("Where", moved, g.taken("before", np.array(0)), "row")
    long = g.column(g("GreaterOrEqual", "steps", np.int64(2 * lag)))
    past = g("Where", long, g.taken("earlier", np.array(0)), last)
    for name, row in (("before", "row"), ("earlier", last)):
        kept = g("Slice", name, np.array([1]), np.array([lag]), np.array([1]))
        g("Concat", kept, g.column(row), axis=1, out=f"next_{name}")
    g("Add", "steps", np.int64(1), out="next_steps")
    listens = bool(detection.detector_.context_quantile[:-1].any())
    errors = g(
        "Mul", _errors(g, model, last, past, due, moved, listens), g("Where", long, np.float64(1), np.float64(UNSURE))
    )
    shares = _evidence(g, detection.detector_, errors)
    _surprise(g, shares, _repetitions(g, detection.repeating, model.spec.sensory), detection.repeating[2], model.spec)


def _errors(g: _Graph, model: Any, last: str, past: str, due: str, moved: str, listens: bool) -> str:
    """(Δ - Δ̂)/(s σ) (B, X), and the next traces; and the next context where anybody ``listens`` to it."""
    s, spec, w, a = model.senses_, model.spec, model.network.weights, model.network.association
    sensory, motor, slow = spec.sensory, spec.motor, s.slow

    def scaled(x: str, y: Any, by: NDArray[np.float64]) -> str:
        return g("Div", g("Sub", x, y), by)

    def bounded(x: str) -> str:
        return g.cast(g("Clip", x, np.float64(-FARTHEST), np.float64(FARTHEST)), np.float32)

    def believed(x: str) -> str:
        return g.cast(g("Where", g("Less", g("Abs", x), np.float64(FARTHEST)), x, np.float64(0)), np.float32)

    values, now = scaled("row", s.mean, s.spread), scaled("row", last, s.change)
    changes = g.taken(now, sensory)
    one = g("Add", g("Mul", g.column(g.cast("steps", np.float32)), np.float32(0)), np.float32(1))
    before, command = believed(scaled(last, s.mean, s.spread)), g.taken(values, motor)
    senses = [bounded(g.taken(values, sensory)), bounded(g.taken(now, slow))]
    then = believed(g.taken(scaled(last, past, s.change), slow))
    inputs = g("Concat", before, believed(changes), then, believed(command), one, axis=1)

    f = g("Tanh", g("MatMul", inputs, a.V.T))
    expected = g("Add", g("MatMul", inputs, a.D.T), g("MatMul", f, a.U.T))
    spread = g("Add", g("MatMul", f, a.W_S.T), a.b_S)
    spread = g("Min", g("Max", spread, a.span_S[0]), a.span_S[1])
    error = g("Div", g("Sub", bounded(changes), expected), a.remainder)
    error = g("Mul", error, g("Exp", g("Mul", spread, np.float32(-0.5))))

    rows = g("Concat", *senses, bounded(command), one, axis=1)
    K, size = len(DECAYS), len(w.W_F) + 1
    decays = np.repeat(DECAYS, size)
    taken = g("Mul", g("Tile", rows, np.array([1, K])), np.repeat(w.gains, size))
    g("Where", due, g("Add", g("Mul", "traces", decays), taken), "traces", out="next_traces")
    if listens:
        g("Where", due, g("Tanh", g("MatMul", "traces", w.W_C.T)), "expected", out="next_expected")
    else:  # nobody does, so that it stays at 0
        g("Identity", "expected", out="next_expected")
    return g.cast(g("Where", moved, error, np.float32(0)), np.float64)


def _evidence(g: _Graph, d: Any, errors: str) -> str:
    """Each error's share (B, X) of what the errors' evidence comes to, and the next evidence."""
    a = d.gains[:, None]  # (G, 1)
    pulled = g("Div", errors, g("Sqrt", g("Add", g("Pow", g("Div", errors, d.bound), 2.0), 1.0)))
    whitened = g("MatMul", pulled, d.whitening)
    ahead = g("Sub", g("Unsqueeze", whitened, np.array([1])), "vector")
    vector = g("Add", "vector", g("Mul", ahead, a), out="next_vector")  # (B, G, X)
    count = g.cast(g("Add", "counted", np.int64(1), out="next_counted"), np.float64)
    faded = g("Pow", (1.0 - a) ** 2, g("Unsqueeze", count, np.array([1, 2])))  # (B, G, 1)
    variance = g("Mul", g("Sub", 1.0, faded), a / (2.0 - a))
    ratios = g("Div", g("Pow", vector, 2.0), g("Mul", variance, d.ceiling))
    ratios = g("Exp", g("Mul", g("Log", g("Max", ratios, TINY)), d.tail))
    greatest = g("Max", g("ReduceMax", ratios, axes=[1, 2], keepdims=1), TINY)  # (B, 1, 1)
    powers = g.summed(g("Pow", g("Div", ratios, greatest), float(POWER)), 1)  # (B, X)
    total = g.column(g.summed(powers, 1))
    context = g.cast("next_expected", np.float64)
    lately = g("Add", "lately", g("Mul", g("Sub", context, "lately"), CONTEXT_GAIN), out="next_lately")
    drive = g("MatMul", g("Concat", context, lately, axis=1), d.context_quantile[:-1, None])
    usual = g("Clip", g("Add", drive, d.context_quantile[-1]), *d.context_range)  # (B, 1)
    value = g("Div", g("Mul", g("Squeeze", greatest, np.array([2])), g("Pow", total, 1.0 / POWER)), g("Exp", usual))
    return g("Mul", g("Div", powers, g("Max", total, TINY)), value)


def _repetitions(g: _Graph, repeating: Any, sensory: NDArray[np.intp]) -> str:
    """How unlikely (B, X) senses repeat themselves by chance, and the next count of it."""
    steps, most, _ = repeating
    now = g("Equal", g("Identity", g.taken("row", sensory), out="next_said"), "said")
    g("Identity", now, out="next_again")
    after, first = (g("Where", now, steps[k, 1], steps[k, 0]) for k in (1, 0))
    found = g("Add", "unlikely", g("Where", "again", after, first))
    return g("Min", g("Max", found, 0.0), most, out="next_unlikely")


def _surprise(g: _Graph, shares: str, unlikely: str, offset: NDArray[np.float64], spec: Any) -> None:
    """The value and the attribution: errors' shares, and what is stuck beside them; what is not finite above all."""
    stuck = g("Greater", unlikely, 0.0)
    odd = g("Where", stuck, g("Exp", g("Mul", g("Sub", unlikely, offset), TAIL_INDEX)), 0.0)
    found = g.column(g.summed(shares, 1))
    greatest = g("Max", found, g("ReduceMax", odd, axes=[1], keepdims=1), TINY)
    own = g("Pow", g("Div", found, greatest), float(POWER))
    parts = g("Pow", g("Div", odd, greatest), float(POWER))
    total = g("Add", own, g.column(g.summed(parts, 1)))
    pooled = g("Div", g("Mul", greatest, g("Pow", total, 1.0 / POWER)), g("Max", total, TINY))
    kept = g("Mul", shares, g("Div", g("Mul", pooled, own), g("Max", found, TINY)))
    shared = g("Where", g("Greater", total, own), g("Add", kept, g("Mul", pooled, parts)), shares)
    placed = g("MatMul", shared, np.eye(spec.size)[spec.sensory])
    broken = g("Or", g("IsNaN", "row"), g("IsInf", "row"))
    some = g("Greater", g("ReduceMax", g.cast(broken, np.float64), axes=[1], keepdims=1), 0.0)
    g("Where", some, g("Where", broken, np.inf, 0.0), placed, out="attribution")
    value = g.summed("attribution", 1)
    g("Where", g("IsNaN", value), np.inf, value, out="value")
