"""The actuator as one compiled function that needs no Python: what an FMU runs.

It is the very equations of :mod:`eha_monitor.physics`, compiled by numba for any processor of the
architecture; nothing is written down a second time.  Run as a module it writes the LLVM assembly
of the function, which :mod:`eha_monitor.exports.fmu` turns into shared libraries.
"""

import sys
from pathlib import Path

import numpy as np
from numba import carray, types

from eha_monitor.compiled import ANNOUNCER, literal_unroll, njit
from eha_monitor.physics import plant, signals
from eha_monitor.physics.contributions import N_EFFECTS, N_THETA
from eha_monitor.physics.effect import no_circuit
from eha_monitor.physics.effects import CATALOGUE

NAME = "eha_kernel"
CIRCUIT, ADVANCE, OUTPUTS, REST = range(4)  # what the function is asked for
ROWS, KEPT = 8192, 4096  # integration steps of the input that are held; kept when they are full
N_OUT = 6  # x, v, p1, p2 as the sensors show them, shaft speed, its input

_WITH_CIRCUIT = {i: effect.circuit for i, effect in enumerate(CATALOGUE.values())
                 if effect.circuit is not no_circuit}
_CIRCUITS = tuple(_WITH_CIRCUIT.values())
_AT = np.array(list(_WITH_CIRCUIT))
_REALS, _WHOLE = types.CPointer(types.float64), types.CPointer(types.int64)
SIGNATURE = types.void(
    types.int64, *(_REALS,) * 8, _WHOLE, types.int64, _WHOLE, types.int64,
    types.CPointer(types.boolean), _WHOLE, *(types.float64,) * 6, types.int64, types.boolean)


def kernel(what, y_, theta_, w_, memory_, past_, u_, scratch_, out_, terms_, n_terms, updates_,
           n_updates, active_, places_, t, h, value, slope, load, load_slope, n, closed):
    """Set the circuit's constants, take ``n`` steps, say what the sensors show, or come to rest.

    Parameters
    ----------
    what : ``CIRCUIT``, ``ADVANCE``, ``OUTPUTS`` or ``REST`` (at the position of the state).
    y_, theta_, w_, memory_, past_ : state, parameters, circuit, memory and past of
        :mod:`eha_monitor.physics.plant`, as pointers.
    u_ : (ROWS, 4) the input's course, one cubic for each integration step.
    scratch_ : (N_CONTRIBUTIONS + N_SIGNALS,);  out_ : (N_OUT,) written.
    terms_, updates_, active_ : the effects that are active.
    places_ : newest entry of the past, row of the input at the present time.
    t, h : time since the start and length of a step, s.
    value, slope : input at ``t`` (x_d in m, or the shaft speed in rad/s) and its rate.
    load, load_slope : force against positive motion, N, and its rate.
    n, closed : steps to take; whether the drive closes the loop.
    """
    theta = carray(theta_, (N_THETA,))
    w, active = carray(w_, (signals.N_CIRCUIT,)), carray(active_, (N_EFFECTS,))
    if what == CIRCUIT:
        # As contributions.circuit_of, which makes an array: here nothing is allocated.
        w[:] = 0.0
        for place in signals.LIMITS:
            w[place] = np.inf
        count = 0
        for circuit in literal_unroll(_CIRCUITS):
            which = _AT[count]
            count += 1
            if active[which]:
                first = signals.N_BASE + which * signals.MAX_PARAMETERS
                circuit(theta[first : first + signals.MAX_PARAMETERS], w)
        return
    u, places = carray(u_, (ROWS, 4)), carray(places_, (2,))
    actuator = plant.Actuator(
        carray(y_, (plant.N_STATE,)), carray(memory_, (N_EFFECTS, signals.MAX_MEMORY)),
        carray(past_, (plant.RING, 4)), places[:1])
    scratch = carray(scratch_, (signals.N_CONTRIBUTIONS + signals.N_SIGNALS,))
    c, s = scratch[:signals.N_CONTRIBUTIONS], scratch[signals.N_CONTRIBUTIONS:]
    equations = plant.Equations(theta, carray(terms_, (n_terms,)), carray(updates_, (n_updates,)),
                                w, c, s)
    if what == REST:
        plant.come_to_rest(actuator.y, actuator.memory, equations, actuator.y[plant.Y_X], load)
        return
    # Nothing is held, so nothing has been heard.
    given, step = plant.Given(u, 1, 0, closed, False, s), plant.Step(h, 1)
    if what == OUTPUTS:
        out, here = carray(out_, (N_OUT,)), places[1]
        u[here, 0], u[here, 1], u[here, 2], u[here, 3] = value, slope * h, 0.0, 0.0
        plant.sense(actuator, t, step, w, out)
        out[5], out[4] = plant.speed_now(actuator, here, given, step, equations)
        return
    c[:] = 0.0
    for i in range(n):
        here = places[1]
        if here == ROWS - 1:
            for row in range(KEPT):
                for column in range(4):
                    u[row, column] = u[here - KEPT + row, column]
            here = KEPT
        u[here, 0], u[here, 1], u[here, 2], u[here, 3] = value + slope * i * h, slope * h, 0.0, 0.0
        actuator.y[plant.Y_FORCE] = load + load_slope * (i + 0.5) * h
        plant.advance(actuator, t + i * h, here, given, step, equations)
        places[1] = here + 1


def assembly() -> tuple[str, str]:
    """Return the LLVM assembly of the compiled function, and its name in there."""
    ANNOUNCER.quiet = True
    made = njit(kernel, cache=False)
    made.compile(SIGNATURE)
    name = next(iter(made.overloads.values())).fndesc.mangled_name
    return made.inspect_llvm(made.signatures[0]), name


if __name__ == "__main__":
    text, mangled = assembly()
    Path(sys.argv[1]).write_text(f"; {mangled}\n{text}", encoding="utf-8")
