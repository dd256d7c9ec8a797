"""Native code beside plain C of the same step without any sums, for agents with little to compute.

A ring of Van der Pol oscillators, and one of masses in space with drag. C is what somebody would
write by hand: arrays for each state, one loop over the agents, compiled for this processor.
`engine.py` shows the ratios where a C compiler is there.
"""

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import jax.numpy as jnp
import numpy as np

import echelon as ech
from echelon.core.numerics import precision

AGENTS, STEPS, DT = 10_000, 1_000, 0.005
_DRAG = 0.3

_SOURCE = """
#include <math.h>
typedef {T} T;
#define N {agents}
{rate}
void run(T *restrict x, T *restrict next, const T *restrict K, long steps) {{
  for (long step = 0; step < steps; step++) {{
    for (long i = 0; i < N; i++) {{
      T z[{n}], s[{n}], k1[{n}], k2[{n}], k3[{n}], k4[{n}], at[{n}], u[{m}];
      for (int d = 0; d < {n}; d++) {{
        const T *row = x + d * (N + 32) + 16;
        s[d] = row[i];
        z[d] = (s[d] - row[i - 1]) + (s[d] - row[i + 1]);
      }}
      for (int j = 0; j < {m}; j++) {{
        u[j] = 0;
        for (int d = 0; d < {n}; d++) u[j] -= K[j * {n} + d] * z[d];
      }}
      rate(s, u, k1);
      for (int d = 0; d < {n}; d++) at[d] = s[d] + (T)(0.5 * {dt}) * k1[d];
      rate(at, u, k2);
      for (int d = 0; d < {n}; d++) at[d] = s[d] + (T)(0.5 * {dt}) * k2[d];
      rate(at, u, k3);
      for (int d = 0; d < {n}; d++) at[d] = s[d] + (T){dt} * k3[d];
      rate(at, u, k4);
      for (int d = 0; d < {n}; d++)
        next[d * (N + 32) + 16 + i] =
            s[d] + (T)({dt} / 6.0) * (k1[d] + 2 * k2[d] + 2 * k3[d] + k4[d]);
    }}
    for (int d = 0; d < {n}; d++) {{
      T *row = next + d * (N + 32) + 16;
      row[0] = x[d * (N + 32) + 16];
      row[-1] = row[N - 1];
      row[N] = row[0];
    }}
    T *other = x;
    x = next;
    next = other;
  }}
}}
"""
_RATES = {
    "Van der Pol": """
static inline void rate(const T *s, const T *u, T *k) {
  k[0] = s[1];
  k[1] = (1 - s[0] * s[0]) * s[1] - s[0] + u[0];
}""",
    "masses with drag": f"""
static inline void rate(const T *s, const T *u, T *k) {{
  T speed = sizeof(T) == 8 ? sqrt(s[3] * s[3] + s[4] * s[4] + s[5] * s[5] + (T)1e-6)
                           : sqrtf(s[3] * s[3] + s[4] * s[4] + s[5] * s[5] + (T)1e-6);
  for (int d = 0; d < 3; d++) {{
    k[d] = s[3 + d];
    k[3 + d] = u[d] - (T){_DRAG} * speed * s[3 + d];
  }}
}}""",
}


@final
class DraggedMass(ech.ControlAffine):
    """A mass in space, pushed, with drag by the square of its speed."""

    state_names = ("x", "y", "z", "vx", "vy", "vz")
    input_names = ("ax", "ay", "az")
    state_groups = {"position": ("x", "y", "z")}
    position = ("x", "y", "z")

    def drift(self, x: Any) -> Any:
        """Return f(x)."""
        v = x[3:]
        return jnp.concatenate([v, -_DRAG * jnp.sqrt(v @ v + 1e-6) * v])

    def input_map(self, x: Any) -> Any:
        """Return g(x)."""
        return jnp.concatenate([jnp.zeros((3, 3), x.dtype), jnp.eye(3, dtype=x.dtype)])


MODELS: dict[str, Callable[[], ech.ControlAffine]] = {
    "Van der Pol": ech.models.VanDerPol,
    "masses with drag": DraggedMass,
}


def ring(name: str) -> ech.Parts:
    """Return a ring of agents behind a leader without input."""
    model, graph = MODELS[name](), ech.Graph.ring(AGENTS)
    gain = ech.synthesize(model, ech.Graph.ring(20), ech.gains.Riccati(coupling=0.25))
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="none"))
    formation = ech.Formation(np.zeros((AGENTS, len(model.state_names))))
    return ech.Parts(
        model,
        graph,
        formation,
        drive,
        initial=np.tile(0.1 * np.sin(np.arange(AGENTS))[:, None], (1, len(model.state_names))),
    )


def compiler() -> str | None:
    """Return the path of a C compiler; None where there is none."""
    return shutil.which("gcc") or shutil.which("clang")


@final
class PlainC:
    """The steps of a ring in C.

    Args:
        name: of the model.
        bits: 64 or 32.
        gain: K (m, n), with the coupling.
    """

    def __init__(self, name: str, bits: int, gain: np.ndarray) -> None:
        """Compile the code."""
        (m, n), cc = gain.shape, compiler()
        assert cc is not None
        self.kind, self.states = np.dtype(f"f{bits // 8}"), n
        numbers = {"T": "double" if bits == 64 else "float", "agents": AGENTS, "dt": DT}
        source = _SOURCE.format(rate=_RATES[name], n=n, m=m, **numbers)
        with tempfile.TemporaryDirectory() as folder:
            text, library = Path(folder, "step.c"), Path(folder, "step.so")
            text.write_text(source)
            flags = "-O3 -march=native -fno-math-errno -mprefer-vector-width=512 -shared -fPIC -lm"
            subprocess.run([cc, text, "-o", library, *flags.split()], check=True)
            self._run = ctypes.CDLL(str(library)).run
        self._run.argtypes = [ctypes.c_void_p] * 3 + [ctypes.c_long]
        self.gain = np.ascontiguousarray(gain, self.kind)

    def after(self, states: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
        """Return the states (N, n) after an even number of steps, and the CPU seconds."""
        rows = np.zeros((2, self.states, AGENTS + 32), self.kind)
        rows[:, :, 16:-16] = states.T
        rows[:, :, 15], rows[:, :, AGENTS + 16] = states[-1], states[0]
        begin = time.process_time()
        self._run(rows[0].ctypes.data, rows[1].ctypes.data, self.gain.ctypes.data, steps)
        return rows[0, :, 16:-16].T.copy(), time.process_time() - begin


def beside(name: str, native: Any, bits: int) -> Callable[[], float]:
    """Return the rate of one turn in C, after it is seen to step as native code does."""
    gain, states = native.loop.laws.follower.gain, np.asarray(native.states)
    with precision("float64"):
        g = np.asarray(native.loop.model.input_map(jnp.zeros(states.shape[1])))
    plain = PlainC(name, bits, gain.coupling * gain.R_inverse @ g.T @ gain.P)
    with precision(f"float{bits}"):  # type: ignore[arg-type]
        ours = native.advance(native.start(), np.array([20], np.int32), None).now.states
    # The leader rests at the origin.
    assert np.allclose(ours, plain.after(states, 20)[0], atol=1e-6), "not the same"
    return lambda: AGENTS * STEPS / plain.after(states, STEPS)[1]
